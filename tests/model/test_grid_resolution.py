"""Grids no finer than the photos can show."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from nerf_lightning.cameras import Bounds, bounds
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import RayDataModule, save_npz
from nerf_lightning.model import HashGridField, TensoRFField, VoxelField
from nerf_lightning.model import tensorf as planes
from nerf_lightning.runs.folder import load_run
from nerf_lightning.synthetic.objects import MARBLE, make_object_scene
from nerf_lightning.training.train import train

BOX = torch.tensor([[-1.0, -0.5, -1.0], [1.0, 0.5, 1.0]])


def hashgrid(bounds: Bounds, base_resolution: int, max_resolution: int, size: str) -> list[int]:
    given = {"base_resolution": base_resolution, "max_resolution": max_resolution, "size": size}
    field = HashGridField(bounds, num_levels=3, log2_hashmap_size=8, **given)
    return [side for side, *_ in field.grid.cells]


def tensorf(bounds: Bounds, base_resolution: int, max_resolution: int, size: str) -> list[int]:
    return TensoRFField(bounds, 2, 2, base_resolution, max_resolution, size=size).resolutions


def voxels(bounds: Bounds, base_resolution: int, max_resolution: int, size: str) -> list[int]:
    return VoxelField(bounds, base_resolution, max_resolution, size=size).growth.resolutions


GRIDS = pytest.mark.parametrize("resolutions", [hashgrid, tensorf, voxels])
Resolutions = Callable[[Bounds, int, int, str], list[int]]


@pytest.mark.parametrize(("unbounded", "across"), [(False, 20), (True, 40)])
def test_pixels_across_are_of_unit_cube(unbounded: bool, across: int):
    assert Bounds(BOX, unbounded, pixel_footprint=0.1).unit_cube_pixels == pytest.approx(across)
    # One pixel along the longest axis is 1 / across of the unit cube.
    bounds = Bounds(BOX, unbounded, pixel_footprint=0.1)
    step = bounds.to_unit(torch.tensor([0.1, 0, 0])) - bounds.to_unit(torch.zeros(3))
    assert float(step[0]) == pytest.approx(1 / across)


@GRIDS
def test_grid_auto_size_has_two_cells_a_pixel_at_most(resolutions: Resolutions):
    bounds = Bounds(BOX, pixel_footprint=0.1)
    auto, fixed = resolutions(bounds, 16, 100, "auto"), resolutions(bounds, 16, 100, "fixed")
    assert auto[0] == fixed[0] == 16 and auto[-1] == 40 and fixed[-1] == 100
    assert resolutions(bounds, 16, 30, "auto") == resolutions(bounds, 16, 30, "fixed")
    assert resolutions(Bounds(BOX), 16, 100, "auto") == fixed, "no limit without photos"
    assert set(resolutions(Bounds(BOX, pixel_footprint=0.5), 16, 100, "auto")) == {8}, "as few pixels do"


@pytest.mark.parametrize(
    ("unbounded", "across", "max_resolution", "width"),
    [(False, 150, 160, 32), (False, 450, 240, 48), (False, 9000, 320, 64), (True, 800, 160, 32)],
)
def test_tensorf_large_photos_enlarge_planes_and_network(unbounded: bool, across: int, max_resolution: int, width: int):
    """Plane entries scale with the width of the photos, neurons with the resolution of the planes."""
    bounds = Bounds(BOX, unbounded, pixel_footprint=2 / across)
    field, explicit = TensoRFField(bounds, 2, 2), TensoRFField(bounds, 2, 2, max_resolution=100, width=24)
    assert field.resolutions[-1] == max_resolution and field.color_net[0].out_features == width
    assert explicit.resolutions[-1] == 100 and explicit.color_net[0].out_features == 24
    assert TensoRFField(bounds, 2, 2, max_resolution=100).color_net[0].out_features == 32
    assert TensoRFField(Bounds(BOX, unbounded), 2, 2, base_resolution=200).resolutions[-1] == 200


def test_run_on_large_photos_has_finer_field(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(bounds, "REFERENCE_WIDTH_PX", 4)  # so that small photos count as large
    monkeypatch.setattr(planes, "MIN_STEPS_PER_STAGE", 2)
    monkeypatch.setattr(planes, "DEFAULT_MAX_RESOLUTION", 24)
    save_npz(make_object_scene(MARBLE, size=24, views=5, held_out=1), tmp_path / "scene.npz")
    args = ["dataset=photos", f"dataset.path={tmp_path}/scene.npz", "recipe=tensorf_medium", "model.base_resolution=8"]
    args += ["model.size=fixed", "model.width=8", "model.stages=3", "dataset.samples=500", "device=cpu", "~logger"]
    scales: list[float] = []
    monkeypatch.setattr(RayDataModule, "adapt_num_rays", lambda data, *drawn: scales.append(data._resolution_scale))
    args += ["callbacks.orbit=null", "callbacks.snapshots.steps=[]", "budget.steps=7"]
    train(compose_config(args, tmp_path / "run"))
    system = load_run(tmp_path / "run").system
    scale = system.field.resolution_scale
    assert scales == [1.0] * 4 + [scale] * 3, "the target number of samples follows the field's resolution"
    assert scale > 1.1 and system.sampler.samples == round(3 * system.sampler.grid.resolution**2 / 64) > 192 * 1.1**2
    assert system.field.resolutions[-1] == round(24 * scale)
