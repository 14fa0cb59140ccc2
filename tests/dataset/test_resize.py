"""Automatic photo size, and reduced copies in image folders."""

from collections.abc import Callable
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.config.build import build_data
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import RayDataModule, Views, open_scene, save_npz
from nerf_lightning.dataset import resize as resize_module
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.photo_loading import PhotoLoadOptions, PosedPhoto, load_views
from nerf_lightning.dataset.resize import AutoResize, choose_resize, compute_auto_resize, find_downscaled
from nerf_lightning.errors import InputError
from nerf_lightning.runs.folder import load_config, save_config
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.runs.scene_file import read_scene_file, save_scene
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.utils.device import CPU
from tests.helpers.scene_writers import write_scene


@pytest.fixture(scope="module")
def views(ball_views_of: Callable[..., Views]) -> Views:
    return ball_views_of(6)


def test_compute_auto_resize_longest_side_follows_work():
    for seconds, steps, threads, longest in (
        (180, None, 2, 800),
        (180, None, 16, 1600),
        (60, None, 2, 800),  # no smaller
        (1440, 10, 2, 800),  # whichever ends first
        (None, 48000, 1, 1600),
        (None, None, 32, 1600),  # 90 s
    ):
        assert compute_auto_resize(seconds, steps, CPU, threads).longest == longest


def test_choose_resize_divides_by_a_whole_number(monkeypatch: pytest.MonkeyPatch):
    for size, longest in (((4032, 3024), 1008), ((1080, 1920), 960), ((1440, 1080), None)):
        assert choose_resize("here", [(300, 200), size], 3, AutoResize(1000)) == longest
    monkeypatch.setattr(resize_module, "free_memory", lambda: 2.5 * 100 * 3 * 700 * 525)
    assert choose_resize("here", [(4000, 3000)] * 100, 3, AutoResize(1000)) == 667, "no room for a quarter"
    with pytest.raises(InputError, match="expected auto, null or the longest side"):
        choose_resize("here", [(4, 3)], 3, "large")


def test_open_scene_reduced_copies_that_fit_are_used(views: Views, tmp_path: Path):
    write_scene("colmap", tmp_path, views)
    names = [file.name for file in (tmp_path / "images").iterdir()]
    for factor in (2, 4):
        (tmp_path / f"images_{factor}").mkdir()
        for name in names:
            pixels = np.full((40 // factor, 48 // factor, 4), 70 + factor, np.uint8)
            imageio.imwrite(tmp_path / f"images_{factor}" / name, pixels)
    half = open_scene(str(tmp_path), options=PhotoLoadOptions(24))
    assert (half.train.pixels == 72).all() and half.train.cameras.size(0) == (24, 20)
    torch.testing.assert_close(half.train.cameras.K[0], views.cameras.resize((24, 20)).K[0], atol=1e-4, rtol=0)
    photo = tmp_path / "images" / names[0]
    for size, folder in (((25, 21), "images"), ((13, 11), "images_2"), ((12, 10), "images_4")):
        assert find_downscaled(photo, size, False) == tmp_path / folder / names[0]
    imageio.imwrite(tmp_path / "images_4" / names[0], np.zeros((10, 12, 3), np.uint8))
    assert find_downscaled(photo, (12, 10), False).parts[-2] == "images_2", "without alpha it is another photo"


def test_load_views_reduced_jpeg_is_averaged(tmp_path: Path):
    """Compared with a PNG, which is decoded at full size."""
    y, x = np.mgrid[:96, :160]
    pixels = np.stack([x, 2 * y, 255 - x], axis=-1).astype(np.uint8)
    mask = np.where((x - 70) ** 2 + (y - 50) ** 2 < 900, 255, 0).astype(np.uint8)
    imageio.imwrite(tmp_path / "mask.png", mask)
    intrinsics = Intrinsics(160, 96, 100.0, 100.0, 80.0, 48.0)
    found = {}
    for suffix in ("png", "jpg"):
        file = tmp_path / f"a.{suffix}"
        imageio.imwrite(file, pixels)
        shots = [PosedPhoto("a", file, np.eye(4), intrinsics, tmp_path / "mask.png")]
        found[suffix] = load_views(tmp_path, shots, PhotoLoadOptions(resize=40, masked="ignore"))
    a, b = found["png"], found["jpg"]
    whole = cv2.resize(mask, (40, 24), interpolation=cv2.INTER_AREA) >= 250
    assert a.cameras.size(0) == b.cameras.size(0) == (40, 24)
    assert np.array_equal(a.view_mask(0), whole) and np.array_equal(b.view_mask(0), whole) and 0.1 < whole.mean() < 0.3
    assert (a.pixels.int() - b.pixels.int()).abs().max() <= 8


def test_reload_data_keeps_the_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Independent of budget, threads and memory at that time."""
    save_npz(bricks(size=48, train_views=4, val_views=2), tmp_path / "scene.npz")
    monkeypatch.setattr(resize_module, "MIN_LONGEST_PX", 16)
    monkeypatch.setattr(resize_module, "REFERENCE_LONGEST_PX", 400)
    options = ["dataset=photos", f"dataset.path={tmp_path / 'scene.npz'}", "budget.steps=1", "threads=2"]
    cfg = compose_config(options, tmp_path)
    data = build_data(cfg)
    assert isinstance(data, RayDataModule)
    resolution = data.scene.resolution
    assert resolution == (24, 24), "auto is the default"
    save_scene(data, tmp_path)
    cfg.budget.steps = 10**6
    save_config(cfg, tmp_path)
    assert build_data(cfg).scene.resolution == (48, 48)
    assert reload_data(load_config(tmp_path), read_scene_file(tmp_path)).scene.resolution == resolution
