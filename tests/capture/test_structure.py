import json
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pycolmap
import pytest
import yaml
from capture.views import SIX, SMALL

from benchmarks.synthetic.photos import Flaws, render_photo
from benchmarks.synthetic.viewpoints import object_cameras
from nerf_lightning.capture.outputs import Packing
from nerf_lightning.capture.poses import structure
from nerf_lightning.capture.poses.structure import capture_without_tags
from nerf_lightning.dataset import open_scene
from nerf_lightning.errors import InputError


def test_photos_without_tags_give_the_same_outputs(tmp_path: Path):
    c2ws = object_cameras(SIX, SMALL, 24, seed=0)[:8]  # in small steps around a third of a circle
    truth, folder = {f"{i}.png": c2w for i, c2w in enumerate(c2ws)}, tmp_path / "photos"
    folder.mkdir()
    for name, c2w in truth.items():
        imageio.imwrite(folder / name, render_photo(SIX, SMALL, c2w, True, Flaws(), seed=0, samples=2))
    packing = Packing(tmp_path / "scene.npz", longest=200, holdout=4)
    photos, _ = capture_without_tags(folder, packing)
    placed = [photo for photo in photos if photo.c2w is not None]
    assert len(placed) >= 6 and all(0 < photo.reprojection_px < 3 for photo in placed)
    # Up to turn, shift and scale, which photos alone do not tell, the cameras stand where they stood.
    found = np.stack([photo.c2w[:3, 3] for photo in placed])
    exact = np.stack([truth[photo.name][:3, 3] for photo in placed])
    a, b = found - found.mean(0), exact - exact.mean(0)
    u, s, v = np.linalg.svd(b.T @ a)
    mirror = np.linalg.det(u @ v)
    fitted = s @ [1, 1, mirror] / (a**2).sum() * a @ (u @ np.diag([1, 1, mirror]) @ v).T
    assert np.median(np.linalg.norm(fitted - b, axis=1) / np.linalg.norm(exact, axis=1)) < 0.05
    assert (u @ np.diag([1, 1, mirror]) @ v)[2, 2] > 0.98  # up is up
    opened = open_scene(str(tmp_path / "scene.npz"))
    assert opened.resolution == (200, 150) and len(opened.train) + len(opened.val) == len(placed)
    entries = json.loads((tmp_path / "cameras.json").read_text())["photos"]
    assert [entry["name"] for entry in entries] == sorted(truth)
    content = yaml.safe_load((tmp_path / "calibration.yaml").read_text())
    assert content["fx"] == pytest.approx(SMALL.fx, rel=0.1)


def test_photos_of_another_size_or_zoom_are_left_out(tmp_path: Path):
    model, shots = pycolmap.Reconstruction(), {"a": 1, "b": 1, "c": 2, "d": 3, "e": 1}
    for number, (focal, width, height) in enumerate(((50.0, 40, 30), (90.0, 40, 30), (50.0, 30, 40)), 1):
        model.add_camera(pycolmap.Camera.create_from_model_name(number, "OPENCV", focal, width, height))
    images = {name: pycolmap.Image(name=name, camera_id=number, image_id=7) for name, number in shots.items()}
    others = structure._others(tmp_path, images, model)
    assert set(others) == {"c", "d"} and "zoom" in others["c"] and "30x40 pixels, held the other way" in others["d"]
    assert structure._lens(model.cameras[2]).fx == 90
    simple = structure._lens(pycolmap.Camera.create_from_model_name(4, "SIMPLE_RADIAL", 50.0, 40, 30))
    assert (simple.fx, simple.fy, simple.cx, simple.cy, simple.distortion) == (50, 50, 20, 15, (0,) * 5)


def test_photos_that_show_nothing(tmp_path: Path):
    for i in range(3):
        imageio.imwrite(tmp_path / f"{i}.png", np.full((120, 160, 3), 100 + i, np.uint8))
    with pytest.raises(InputError, match="0 of 3 photos that hang together, expected at least 3; take more photos"):
        capture_without_tags(tmp_path, Packing(tmp_path / "scene.npz"))
    with pytest.raises(InputError, match=r"orbit: found 9.png, expected a photo's name, such as 0.png"):
        capture_without_tags(tmp_path, Packing(tmp_path / "scene.npz", orbit="9.png"))
    assert not (tmp_path / "scene.npz").exists()


def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    imageio.imwrite(tmp_path / "0.png", np.zeros((12, 16, 3), np.uint8))
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'nerf_lightning\[colmap\]'"):
        capture_without_tags(tmp_path, Packing(tmp_path / "scene.npz"))
