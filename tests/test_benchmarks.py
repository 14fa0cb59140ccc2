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
from benchmarks import agreement, camera_noise, device, image_fields, kernel_cases, photos, step_time
from benchmarks.op_counter import OpCounter, count_kernel_bytes
from benchmarks.synthetic.part_tracer import SUPERSAMPLING, Tracer
from benchmarks.synthetic.parts import BALL, BOX, CYLINDER, Material, make_part
from benchmarks.tables import list_differences
from nerf_lightning import kernels
from nerf_lightning.cameras import transform_poses
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import save_npz
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.synthetic.objects import Box, Sphere, make_hemisphere_cameras, render_photos
from nerf_lightning.training.train import train
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


def spoil(monkeypatch: pytest.MonkeyPatch, name: str, how: Callable[[Tensor], Tensor]) -> None:
    """Breaks the fast version of a kernel but not the reference."""
    right = getattr(kernels, name)
    fast = kernels.has_fast_kernel
    monkeypatch.setattr(kernels, name, lambda *given: how(right(*given)) if fast(given[0]) else right(*given))


def test_compare_kernels_reports_wrong_kernels(few_samples: None, monkeypatch: pytest.MonkeyPatch):
    def refuse(x: Tensor) -> Tensor:
        raise NotImplementedError("not on\nthis device")

    rows = agreement.compare_kernels(CPU)
    assert list_differences(rows) == []
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


def test_op_counter_counts_bytes_read_and_written():
    """Each input once and each output once; of tables, the entries that are read or changed."""
    x, index, source, one = torch.rand(100, 3), torch.arange(10), torch.ones(10, 3), torch.ones(())
    calls = {
        2400: lambda: x + 1,
        3600: lambda: x.add_(x),
        1204: lambda: x.copy_(one.expand(100, 3)),
        320: lambda: x[index],
        440: lambda: x.index_add_(0, index, source),
    }
    for expected, call in calls.items():
        with OpCounter() as count:
            call()
        assert count.bytes == expected, count.bytes_by_name
    tables, unit, out = torch.zeros(5000, 2), torch.zeros(3, 10), torch.zeros(10, 8)
    size = count_kernel_bytes(["tables", "unit", "out", "positions"], [tables, unit, out, 10], {"L": 4})
    assert size == 4 * (8 * 10 * 4 * 2 + 30 + 80)
    assert count_kernel_bytes(["grad_tables", "positions"], [tables, 10**6], {"L": 4}) == 4 * 2 * 10_000


TINY = {
    kernel_cases: {"NUM_RAYS": 16, "NUM_SAMPLES": 64},
    agreement: {"STEPS": 2, "SCENE": ("dataset=bricks", "dataset.size=16", "dataset.train_views=10")},
    step_time: {"WARMUP_STEPS": 2, "TIMED_PERIODS": 1, "METHODS": ("hashgrid",)},
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
    (row,) = report["step_time"]
    assert row["step_ms"] > 0 and row["operations"] > 20 and row["waits"] >= 1 and row["samples"] > row["rays"] > 0
    assert report["methods"][0]["method"] == "smoke_3d"
    assert "step_ms" in (tmp_path / "table.txt").read_text()


def train_in_process(experiment: str, overrides: list[str], seed: int, folder: Path) -> dict:
    """As `methods.train`, without a process of its own and what a user looks at; fails with the longer budget."""
    if "budget.seconds=0.3" in overrides:
        raise SystemExit("out of memory")
    nothing = [f"callbacks.{name}=null" for name in ("orbit", "snapshots", "checkpoints", "progress", "validation")]
    train(compose_config([f"+experiment={experiment}", *overrides, *nothing, "~logger"], folder), folder=folder)
    return json.loads((folder / "results.json").read_text())


def test_device_reports_all_stages_though_one_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr(device, "train", train_in_process)
    monkeypatch.setattr(device, "QUICK", replace(device.QUICK, seconds=(0.2, 0.3)))
    recipes = ["hashgrid_medium", "hashgrid_capture"]
    words = f"benchmarks device model.log2_hashmap_size=10 --quick --device cpu --output {tmp_path / 'report.json'}"
    monkeypatch.setattr("sys.argv", [*words.split(), "--recipes", ",".join(recipes)])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "not equal: hashgrid_medium (failed: out of memory)" and stopped.value.code == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["kernels"][0]["kernel"].startswith("none for cpu")
    assert [row["recipe"] for row in report["steps"]] == recipes
    assert all(row["step_ms"] > 0 and row["operations"] > 20 and row["bytes"] > 1e6 for row in report["steps"])
    for name in recipes:
        total, *times = (row["ms"] for row in report[f"profile of {name}"])
        assert total > sum(times) > 0.5 * total and times == sorted(times, reverse=True)
    rows = {(row["recipe"], row["seconds"]): row for row in report["trainings"]}
    assert rows["hashgrid_capture", 0.2]["scene"] == "room, 24x24" and rows["hashgrid_medium", 0.2]["psnr"] > 5
    assert [row["line"].count("|") for row in report["Markdown"]] == [9, 9]


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
