"""COLMAP and LLFF folders give the same scene as transforms.json."""

import logging
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pycolmap
import pytest
import torch

from nerf_lightning.cameras import Distortion, Projection
from nerf_lightning.cameras.lenses import normalized_to_directions, undistort
from nerf_lightning.dataset import Scene, Views, open_scene
from nerf_lightning.dataset.formats.colmap_model import CAMERA_MODELS, make_intrinsics
from nerf_lightning.dataset.intrinsics import Intrinsics
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_llff, write_photos, write_transforms


@pytest.fixture(scope="session")
def views(ball_views_of: Callable[..., Views]) -> Views:
    return ball_views_of(6)


def colmap(folder: Path, views: Views, where: str = "sparse/0", text: bool = False) -> Path:
    names = write_photos(folder / "images", views)
    write_colmap(folder / where, views.cameras.c2w.numpy(), names, colmap_cameras(views), text)
    return folder


def assert_same_scene(a: Scene, b: Scene) -> None:
    for ours, theirs in ((a.train, b.train), (a.val, b.val)):
        torch.testing.assert_close(ours.cameras.c2w, theirs.cameras.c2w, atol=1e-5, rtol=0)
        torch.testing.assert_close(ours.cameras.K, theirs.cameras.K, atol=1e-3, rtol=0)
        assert torch.equal(ours.pixels, theirs.pixels)
    torch.testing.assert_close(a.to_source, b.to_source, atol=1e-4, rtol=0)


def test_open_scene_colmap_llff_transforms_agree(views: Views, tmp_path: Path):
    binary = open_scene(str(colmap(tmp_path / "binary", views)))
    assert (len(binary.train), len(binary.val)) == (15, 3), "every 8th of 18 is held out"
    assert_same_scene(binary, open_scene(str(colmap(tmp_path / "text", views, text=True))))
    names = write_photos(tmp_path / "llff" / "images", views)
    write_llff(tmp_path / "llff" / "poses_bounds.npy", views)
    assert_same_scene(binary, open_scene(str(tmp_path / "llff")))
    write_transforms(tmp_path / "llff" / "transforms.json", views, [f"images/{name}" for name in names])
    assert_same_scene(binary, open_scene(str(tmp_path / "llff")))


def test_open_scene_model_folder_means_its_scene(views: Views, tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Of several models the largest is taken."""
    folder = colmap(tmp_path / "scene", views, "colmap/sparse/1")
    few = views[torch.arange(4)]
    names = write_photos(folder / "images", few)
    write_colmap(folder / "colmap/sparse/0", few.cameras.c2w.numpy(), names, colmap_cameras(few))
    with caplog.at_level(logging.WARNING):
        scene = open_scene(str(folder))
    assert "sparse/1: using the largest model; others: 0" in caplog.text
    assert scene.name == "scene" and len(scene.train) == 15
    for below in ("colmap/sparse/1", "colmap/sparse"):
        assert_same_scene(scene, open_scene(str(folder / below)))


VALUES = {"f": 50, "fx": 50, "fy": 51, "cx": 24, "cy": 20, "k1": 0.1, "k2": 0.02, "p1": 0.01, "p2": 0.02, "k3": 0.03}
VALUES |= {"k4": 0.04, "d1": 0.01, "d2": 0.02, "d3": 0.03, "s1": 0.001, "s2": 0.002}


def test_make_intrinsics_agrees_with_pycolmap():
    uv = np.array([[1.5, 2.5], [24, 20], [40.25, 3], [47, 39]])
    for model, (_, names) in CAMERA_MODELS.items():
        parameters = tuple(float(VALUES[name]) for name in names.split())
        camera = pycolmap.Camera(model=model, width=48, height=40, params=parameters)
        rays = rays_of(make_intrinsics("file", "camera 1", model, 48, 40, parameters), uv)
        flat = np.asarray(camera.cam_from_img(uv))
        np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], flat, atol=3e-5, err_msg=model)


def rays_of(intrinsics: Intrinsics, uv: np.ndarray) -> np.ndarray:
    """Directions of pixels in the camera frame."""
    seen = torch.from_numpy((uv - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy))
    flat = undistort(seen, torch.tensor([intrinsics.distortion], dtype=torch.float64))
    return normalized_to_directions(flat, torch.tensor([intrinsics.projection])).numpy()


def test_open_scene_points_and_depths_decide_near(views: Views, tmp_path: Path):
    """Photos on gray noise, so that the scene is unbounded; cameras are 4 units from the center."""
    rng = np.random.default_rng(0)
    noise = torch.from_numpy(rng.integers(0, 255, (*views.images.shape[:3], 3), np.uint8))
    names = write_photos(tmp_path / "images", Views.from_images(noise, views.cameras))
    write_llff(tmp_path / "poses_bounds.npy", views)
    assert open_scene(str(tmp_path)).bounds.near == pytest.approx(0.7 / 4, rel=0.02), "the file says 1"

    def near(points: np.ndarray) -> float | None:
        write_colmap(tmp_path / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views), points=points)
        return open_scene(str(tmp_path)).bounds.near

    middle = rng.normal(0, 0.1, (300, 3))
    assert near(middle) == pytest.approx(0.5, rel=0.02), "0.65 by the points, but the subject may lie before them"
    for unseen in (np.zeros((0, 3)), np.array([[0.0, 0, 1e3]])):
        assert near(unseen) == pytest.approx(0.25, abs=0.01), "the file says 1, and nothing is seen"
    ahead = views.cameras.centers[2].numpy() + 0.2 * views.cameras.c2w[2, :3, 2].numpy()
    assert near(np.concatenate([middle, ahead + 0.01 * middle])) == pytest.approx(0.7 * 0.2 / 4, rel=0.1)


def test_is_invertible_extreme_lens_is_refused():
    """Invertible on the borders in float64, but not in between, or not in float32."""
    for focal, k1 in ((1e5, 900.0), (6000.0, -0.3)):
        assert Intrinsics(6000, 4000, focal, focal, 3000, 2000, Distortion(k1=k1)).is_invertible(), "strong, unfolded"
    fisheye = Intrinsics(640, 480, 111.0, 111.0, 320, 240, Distortion(k1=6e9, d2=-6e12), Projection.FISHEYE)
    perspective = Intrinsics(640, 480, 6443.0, 6443.0, 320, 240, Distortion(k3=2e3, d1=-6e7))
    assert not fisheye.is_invertible() and not perspective.is_invertible()


VARIANTS: dict[str, tuple[str, str, str, str]] = {
    "reduced photos alone": ("sparse/0", "images_4", "{:04d}.png", "{:04d}.png"),
    "two spaces": ("sparse/0", "images", "my  photo {:d}.png", "my  photo {:d}.png"),
    "undistorted below dense/0": ("dense/0/sparse", "dense/0/images", "{:04d}.png", "{:04d}.png"),
    "Windows": ("sparse/0", "images", "cam0\\{:04d}.png", "cam0/{:04d}.png"),
    "photos elsewhere": ("sparse/0", "pictures", "{:04d}.png", "{:04d}.png"),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_open_scene_colmap_variant_matches_the_plain_folder(variant: str, views: Views, tmp_path: Path):
    model, folder, stated, stored = VARIANTS[variant]
    expected = open_scene(str(colmap(tmp_path / "plain", views)))
    for i in range(len(views)):
        image = views.image(i).numpy()
        image = image[::4, ::4] if folder == "images_4" else image
        file = tmp_path / "s" / folder / stored.format(i)
        file.parent.mkdir(parents=True, exist_ok=True)
        imageio.imwrite(file, image)
    names = [stated.format(i) for i in range(len(views))]
    write_colmap(tmp_path / "s" / model, views.cameras.c2w.numpy(), names, colmap_cameras(views), text=True)
    scene = open_scene(str(tmp_path / "s"))
    assert scene.name == "s" and len(scene.train) == len(expected.train)
    torch.testing.assert_close(scene.train.cameras.centers.sort(0)[0], expected.train.cameras.centers.sort(0)[0])
    factor = 4 if folder == "images_4" else 1
    assert float(scene.train.cameras.K[0, 0, 0]) == pytest.approx(float(expected.train.cameras.K[0, 0, 0]) / factor)
    if factor == 1 and "spaces" not in variant:
        assert torch.equal(scene.train.image(0), expected.train.image(0))
