"""Photos without tags are placed against those with tags."""

import json
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from benchmarks.capture import home
from benchmarks.synthetic.photos import Flaws, Truth, render_photo
from nerf_lightning.capture.photo_status import photo_statuses
from nerf_lightning.capture.poses.geometry import angle_between
from nerf_lightning.capture.run import capture_scene
from tests.helpers.tag_views import SIX, SIZE, SMALL


def test_capture_scene_with_hidden_tags_places_photos_by_texture(made: tuple[Path, Truth], tmp_path: Path):
    shown, truth = made
    shutil.copytree(shown, tmp_path, dirs_exist_ok=True)
    hidden = ["003.png", "005.png"]
    for name in hidden:
        photo = render_photo(SIX, SMALL, truth.photos[name], True, Flaws(), seed=0, samples=2, hidden=True)
        imageio.imwrite(tmp_path / "photos" / name, photo)
    given = tmp_path / "calibration", tmp_path / "photos", SIZE, tmp_path / "scene.npz"
    found = capture_scene(*given, dictionary="DICT_4X4_50", longest=100)
    by_name = {photo.name: photo for photo in found.photos}
    assert [photo.name for photo in found.photos if photo.by == "texture"] == hidden
    for name in hidden:
        solved, exact = home(found.solved, SIX) @ by_name[name].c2w, truth.photos[name]
        assert np.linalg.norm(solved[:3, 3] - exact[:3, 3]) < 0.02 * np.linalg.norm(exact[:3, 3])
        assert angle_between(solved, exact) < np.radians(1)
        assert 0 < by_name[name].reprojection_px < 2
    entries = {entry["name"]: entry for entry in json.loads((tmp_path / "cameras.json").read_text())["photos"]}
    assert [name for name, entry in entries.items() if entry.get("by") == "texture"] == hidden
    assert "by its texture" in photo_statuses(found)[3].caption
