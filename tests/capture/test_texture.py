"""Photos without tags are placed against those with tags."""

import importlib.util
import json
import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from capture.views import SIX, SIZE, SMALL, camera

from benchmarks.capture import home
from benchmarks.synthetic.photos import Flaws, Truth, render_photo
from nerf_lightning.capture.outcome import photo_outcomes
from nerf_lightning.capture.outputs import Packing
from nerf_lightning.capture.poses.geometry import angle_between, inverse, move
from nerf_lightning.capture.poses.texture import pose_from_points
from nerf_lightning.capture.poses.tracks import linked, triangulated
from nerf_lightning.capture.run import capture


def test_photos_whose_tags_are_hidden_are_placed(
    made: tuple[Path, Truth], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    shown, truth = made
    shutil.copytree(shown, tmp_path, dirs_exist_ok=True)
    hidden = ["003.png", "005.png"]
    for name in hidden:
        photo = render_photo(SIX, SMALL, truth.photos[name], True, Flaws(), seed=0, samples=2, hidden=True)
        imageio.imwrite(tmp_path / "photos" / name, photo)
    packing = Packing(tmp_path / "scene.npz", longest=100)
    found = capture(tmp_path / "calibration", tmp_path / "photos", SIZE, packing, "DICT_4X4_50")
    by_name = {photo.name: photo for photo in found.photos}
    assert [photo.name for photo in found.photos if photo.by == "texture"] == hidden
    for name in hidden:
        told, pose = home(found.solved, SIX) @ by_name[name].c2w, truth.photos[name]
        assert np.linalg.norm(told[:3, 3] - pose[:3, 3]) < 0.02 * np.linalg.norm(pose[:3, 3])
        assert angle_between(told, pose) < np.radians(1)
        assert 0 < by_name[name].reprojection_px < 2
    entries = {entry["name"]: entry for entry in json.loads((tmp_path / "cameras.json").read_text())["photos"]}
    assert [name for name, entry in entries.items() if entry.get("by") == "texture"] == hidden
    assert entries["003.png"]["status"] == "placed"
    captions = [outcome.caption for outcome in photo_outcomes(found)]
    assert "by its texture" in captions[3] and "texture" not in captions[0]

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    without = capture(tmp_path / "calibration", tmp_path / "photos", SIZE, packing, "DICT_4X4_50")
    reasons = {photo.name: photo.reason for photo in without.photos if photo.reason}
    assert sorted(reasons) == hidden
    assert reasons["003.png"].startswith("no tag found; pip install 'nerf_lightning[colmap]'")


def test_tracks_join_matches_and_drop_contradictions():
    tracks = linked([((0, 1), (1, 5)), ((1, 5), (2, 7)), ((0, 2), (1, 6)), ((1, 6), (0, 3))])
    assert tracks == [[(0, 1), (1, 5), (2, 7)]]


def test_points_lie_where_most_photos_see_them():
    poses = {i: inverse(camera([0.3 * i - 0.3, 0.1, 1.0], [0, 0, 0])) for i in range(4)}
    point = np.array([0.05, -0.02, 0.04])
    there = np.stack([move(pose, point[None])[0] for pose in poses.values()])
    tangents = [(p[:2] / p[2])[None] for p in there]
    tangents[2] = tangents[2] + 0.1  # a wrong match
    track = [(i, 0) for i in range(4)]
    ((_, found),) = triangulated([track], tangents, poses, limit=0.004)
    np.testing.assert_allclose(found, point, atol=1e-9)
    assert triangulated([[(0, 0), (2, 0)]], tangents, poses, limit=0.004) == []


def test_few_or_random_points_settle_nothing():
    rng, pose = np.random.default_rng(0), inverse(camera([0.1, 0.2, 0.8], [0, 0, 0]))
    points = 0.1 * rng.standard_normal((60, 3))
    there = move(pose, points)
    seen = there[:, :2] / there[:, 2:]
    fit, count = pose_from_points(list(zip(points, seen, strict=True)), 0.004)
    assert count == 60 and angle_between(fit[0], pose) < 1e-4
    assert pose_from_points(list(zip(points[:10], seen[:10], strict=True)), 0.004) == (None, 10)
    mixed = list(zip(points, rng.permutation(seen), strict=True))
    assert pose_from_points(mixed, 0.004)[0] is None
