"""Benchmarks: error measures, the comparison of kernels, and every part on tiny scenes."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import __main__ as command
from benchmarks import agreement, camera_noise, image_fields, kernel_cases, photos, step_time
from benchmarks.synthetic.part_tracer import SUPERSAMPLING, Tracer
from benchmarks.synthetic.parts import BALL, BOX, CYLINDER, Material, make_part
from benchmarks.tables import list_differences
from nerf_lightning import kernels
from nerf_lightning.cameras import transform_poses
from nerf_lightning.dataset import save_npz
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.synthetic.objects import Box, Sphere, make_hemisphere_cameras, render_photos
from nerf_lightning.utils.device import CPU
from tests.helpers.soft_ball import make_ball_cameras


def test_camera_errors_common_motion_does_not_count():
    truth, center = make_ball_cameras(6, 8), torch.zeros(3)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, 0.1], [0.4, 0.0, 0.2], [-0.1, -0.2, 0.0]]))
    elsewhere = torch.eye(4)
    elsewhere[:3, :3], elsewhere[:3, 3] = 1.7 * turn, torch.tensor([1.0, -2.0, 0.5])
    together = replace(truth, c2w=transform_poses(truth.c2w, elsewhere).float())
    assert max(camera_noise.measure_camera_errors(together, truth, center).values()) < 0.1
    c2w = truth.c2w.clone()
    angle = torch.tensor(0.1)
    c2w[2, :3, :2] = c2w[2, :3, :2] @ torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    found = camera_noise.measure_camera_errors(replace(truth, c2w=c2w), truth, center)
    assert found["degrees"] == pytest.approx(math.degrees(0.1) / 6, rel=1e-2) and found["moved_percent"] < 0.01


def test_tracer_agrees_with_primitives_shadows_and_absorbs():
    gray, cameras = Material((0.5, 0.5, 0.5)), make_hemisphere_cameras(3, 24)
    parts = [
        make_part(BALL, (0.3, 0.2, 0.1), (0.5, 0.5, 0.5), gray),
        make_part(BOX, (-0.5, -0.3, 0), (0.3, 0.4, 0.2), gray),
    ]
    alpha = np.stack([Tracer(parts).render(cameras, view)[..., 3] for view in range(3)])
    primitives = [Sphere((0.3, 0.2, 0.1), 0.5), Box((-0.8, -0.7, -0.2), (-0.2, 0.1, 0.2))]
    truth = render_photos(primitives, cameras, None, SUPERSAMPLING)[..., 3].numpy()
    assert (alpha == truth).mean() > 0.99 and 0.1 < (truth > 0).mean() < 0.9
    plate = make_part(CYLINDER, (0, 0, -0.5), (1.5, 1.5, 0.1), gray)
    points, down = np.array([[0.0, 0.0, -0.4], [1.4, -1.4, -0.4]]) * [0.9, 0.9, 1], np.array([[0.0, 0.0, -1.0]] * 2)
    shaded, bright = Tracer([plate, parts[0]]).shade(np.array([0, 0]), points, down)[:, 0]
    assert shaded < 0.7 * bright and bright < 1
    jelly = make_part(BALL, (0, 0, 0), (0.5, 0.5, 0.5), Material((0.8, 0.1, 0.1), absorption=1.5))
    center = Tracer([jelly]).render(cameras, 1)[11:13, 11:13, 3].mean() / 255  # through the whole diameter
    assert center == pytest.approx(1 - math.exp(-1.5), abs=0.01)


@pytest.fixture
def few_samples(monkeypatch: pytest.MonkeyPatch):
    """Small kernel cases."""
    monkeypatch.setattr(kernel_cases, "NUM_RAYS", 64)
    monkeypatch.setattr(kernel_cases, "NUM_SAMPLES", 256)
    monkeypatch.setattr(agreement, "TIMED_CALLS", 1)


def spoil(monkeypatch: pytest.MonkeyPatch, name: str, how: Callable[[Tensor], Tensor]) -> None:
    """Breaks the fast version of a kernel but not the reference."""
    right = getattr(kernels, name)
    fast = kernels.has_fast_kernel
    monkeypatch.setattr(kernels, name, lambda *given: how(right(*given)) if fast(given[0]) else right(*given))


def test_compare_kernels_reports_wrong_kernels(few_samples: None, monkeypatch: pytest.MonkeyPatch):
    def refuse(x: Tensor) -> Tensor:
        raise NotImplementedError("not on\nthis device")

    rows = agreement.compare_kernels(CPU)
    assert list_differences(rows) == [] and all(row["fast_ms"] > 0 and row["reference_ms"] > 0 for row in rows)
    assert {"march, unbounded", "plane_line_sum", "mark_cells", "interpolate_scalar"} <= {row["kernel"] for row in rows}
    spoil(monkeypatch, "hash_interpolate", lambda x: x + 0.03 * (x - x.detach()))
    spoil(monkeypatch, "spherical_harmonics", lambda x: x * (1 + 1e-3))
    spoil(monkeypatch, "ray_positions", lambda x: x * torch.nan)
    spoil(monkeypatch, "interpolate_scalar", refuse)
    assert list_differences(agreement.compare_kernels(CPU)) == [
        "ray_positions (value error nan)",
        "hash_interpolate (gradient error 3.0e-02)",
        "hash_interpolate_2d (gradient error 3.0e-02)",
        "spherical_harmonics (value error 1.0e-03)",
        "interpolate_scalar (failed: not on this device)",
    ]


TINY = {
    kernel_cases: {"NUM_RAYS": 16, "NUM_SAMPLES": 64},
    agreement: {"TIMED_CALLS": 1, "STEPS": 2, "SCENE": ("dataset=bricks", "dataset.size=16", "dataset.train_views=10")},
    step_time: {"WARMUP_STEPS": 2, "TIMED_PERIODS": 1, "METHODS": ("hashgrid",)}
    | {"NUM_BLOCKS": 4, "FIRST_TIMED_BLOCK": 1, "BLOCK_STEPS": 3},
    camera_noise: {"STEPS": 2, "CONDITIONS": {"exact": camera_noise.CONDITIONS["exact"]}},
    photos: {"SIZE": 16, "VIEWS": 6, "HELD_OUT": 2, "STEPS": 2},
    image_fields: {"KINDS": ("clouds",), "FIELDS": ("hashgrid2d",), "SIZE": 16, "LARGE_SIZE": 16},
}  # fmt: skip


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    for module, sizes in TINY.items():
        for name, value in sizes.items():
            monkeypatch.setattr(module, name, value)


@pytest.mark.long
def test_main_writes_table_and_json(tiny: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    size = ["dataset.size=16", "dataset.train_views=10", "sampler.update_every=2"]
    options = f"--experiments smoke_3d --budgets 0.2 --seeds 0 --device cpu --output {tmp_path}".split()
    monkeypatch.setattr("sys.argv", ["benchmarks", "agreement", "step_time", "methods", *size, *options])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert capsys.readouterr().out.splitlines()[-1] == "all equal" and stopped.value.code == 0
    report = json.loads((tmp_path / "benchmarks.json").read_text())
    assert {row["kernel"] for row in report["kernels"]} >= {"march", "mlp", "hash_interpolate"}
    assert len(report["short trainings"]) == 8 and all(row["psnr"] > 1 for row in report["short trainings"])
    (row,) = report["steps"]
    assert row["step_ms"] > 0 and row["operations"] > 20 and row["waits"] >= 1 and row["samples"] > row["rays"] > 0
    assert report["overhead"][0]["bare_ms"] > 0
    assert report["methods"][0]["method"] == "smoke_3d"
    assert "bare_ms" in (tmp_path / "table.txt").read_text()


@pytest.mark.long
def test_measure_tiny_scenes_and_pictures_give_rows(tiny: None, tmp_path: Path):
    save_npz(bricks(size=16, train_views=6, val_views=2), tmp_path / "scene.npz")
    words = f"--scenes {tmp_path / 'scene.npz'} --recipes hashgrid_medium --seeds 0 --output {tmp_path}".split()
    args = command.parse_args([*words, "dataset.max_side=16", "budget.steps=2", "budget.seconds=null"])
    found = image_fields.measure(args)
    assert {row["table"] for row in found} == {"pictures", "2D fields", "kinds of pictures"}
    assert [row["photos"] for row in photos.measure(args)][:2] == ["one size", "several sizes"]
    args.overrides = []
    rows = camera_noise.measure(args)
    assert [row["refine"] for row in rows] == ["none", "auto"] and all(row["degrees"] < 1e-3 for row in rows[:1])
