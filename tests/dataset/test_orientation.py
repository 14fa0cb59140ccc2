"""Photos with an EXIF rotation."""

import logging
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.dataset import PhotoLoadOptions, Views, open_scene
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import encode_exif
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_llff, write_transforms


def write_sideways(format: str, folder: Path, views: Views) -> Path:
    """Upright cameras, and JPEGs stored rotated left, with the EXIF orientation that rotates them back."""
    (folder / "images").mkdir(parents=True)
    names = [f"{i:04d}.jpg" for i in range(len(views))]
    for i, name in enumerate(names):
        stored = np.rot90(views.image(i)[..., :3].numpy(), 1).copy()
        Image.fromarray(stored).save(folder / "images" / name, quality=95, exif=encode_exif(orientation=6))
    width, height = views.cameras.size(0)
    if format == "colmap":
        write_colmap(folder / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views))
    elif format == "llff":
        write_llff(folder / "poses_bounds.npy", views)
    else:
        write_transforms(folder / "transforms.json", views, [f"images/{name}" for name in names], w=width, h=height)
    return folder


@pytest.mark.parametrize("format", ["colmap", "llff", "transforms"])
def test_open_scene_exif_orientation_that_fits_is_applied(
    format: str, ball_views_of: Callable[..., Views], tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    views = ball_views_of(3)
    folder = write_sideways(format, tmp_path / "s", views)
    with caplog.at_level(logging.WARNING):
        scene = open_scene(str(folder))
    assert "9 photos are rotated by their EXIF orientation" in caplog.text
    assert scene.resolution == views.cameras.size(0)
    difference = (scene.train.image(0).float() - views.image(1)[..., :3]).abs().mean()
    assert float(difference) < 4, "JPEG's rounding"
    with pytest.raises(InputError, match="found 40x48 pixels, expected 48x40"):
        open_scene(str(folder), options=PhotoLoadOptions(orientation="stored"))


def test_open_scene_square_photos_stay_as_stored(
    ball_views_of: Callable[..., Views], tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    views = ball_views_of(3)
    square = Views.from_images(views.images[:, :, 4:44].contiguous(), views.cameras.resize((40, 40)))
    folder = write_sideways("transforms", tmp_path / "s", square)
    with caplog.at_level(logging.WARNING):
        stored = open_scene(str(folder))
    assert "pixels used as stored (dataset.orientation=exif" in caplog.text
    turned = open_scene(str(folder), options=PhotoLoadOptions(orientation="exif"))
    assert torch.equal(stored.train.image(0), torch.rot90(turned.train.image(0), 1))
