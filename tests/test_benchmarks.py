import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from benchmarks import __main__ as command
from benchmarks import alike, cameras, capture, cases, device, drawn, growth, methods, overhead, steps, trainings
from benchmarks import kernels as timing
from nerf_lightning import kernels
from nerf_lightning.cameras import in_other_frame
from nerf_lightning.dataset.picture import load_picture
from nerf_lightning.utils.device import CPU
from tests.helpers.soft_ball import cameras_around_ball

CURVE = [[2.0, 100, 20.0], [8.0, 400, 24.5], [10.5, 500, 26.0], [30.0, 1500, 29.0]]


def run(curve: list[list[float]], **figures) -> dict:
    common = {"steps": 1500, "train_seconds": 30.0, "rays_per_second": 1e5, "render_seconds_per_view": 0.1}
    return common | {"peak_memory_bytes": 1e9, "parameters": 1000, "psnr": curve[-1][2], "curve": curve} | figures


def test_seconds_to_a_quality_is_the_first_moment_at_or_above_it():
    assert [methods.seconds_to(CURVE, db) for db in (20.0, 24, 26.0, 29.5)] == [2.0, 8.0, 10.5, None]


def test_a_middle_run_that_never_gets_there_counts_as_never():
    assert methods.middle([3.0, None, 5.0]) == 5.0
    assert methods.middle([3.0, None, None]) is None


def test_a_line_takes_each_figure_from_the_budget_that_fits():
    short = run([[5.0, 1, 25.0], [10.0, 2, 27.5]], train_seconds=10.0)
    row = methods.summary("m", {30.0: [run(CURVE)] * 3, 10.0: [short] * 3})
    assert row["seconds_to_24_db"] == 5.0 and row["seconds_to_27_db"] == 10.0 and row["seconds_to_30_db"] is None
    assert row["db_at_10_s"] == 27.5 and row["db_at_30_s"] == 29.0 and "db_at_60_s" not in row
    assert row["steps_per_second"] == 50.0 and row["parameter_bytes"] == 4000 and row["seeds"] == 3


def test_the_table_has_a_column_for_every_key():
    lines = command.table([{"a": 1.23456, "b": None}, {"a": "x", "c": 2.5e6}]).splitlines()
    assert lines[0].split() == ["a", "b", "c"] and lines[2].split() == ["1.235", "-", "-"]
    assert lines[3].split() == ["x", "-", "2.5M"]


@pytest.mark.long
def test_one_command_writes_table_and_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr(cases, "RAYS", 16)
    monkeypatch.setattr(cases, "SAMPLES", 64)
    monkeypatch.setattr(timing, "ROUNDS", 1)
    monkeypatch.setattr(overhead, "BLOCKS", 4)
    monkeypatch.setattr(overhead, "FIRST", 1)
    monkeypatch.setattr(overhead, "BLOCK", 3)
    monkeypatch.setattr(growth, "WARMUP", 2)
    monkeypatch.setattr(growth, "BLOCK", 2)
    monkeypatch.setattr(growth, "ROUNDS", 2)
    monkeypatch.setattr(growth, "SAMPLES", (64, 128))
    monkeypatch.setattr(growth, "VIEWS", (3,))
    monkeypatch.setattr(growth, "SIDES", (8,))
    size = ["dataset.size=16", "dataset.train_views=10"]
    arguments = ["benchmarks", "kernels", "growth", "overhead", "methods", *size, "--experiments", "smoke_3d"]
    arguments += ["--budgets", "0.2", "--seeds", "0", "--output", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)
    command.main()
    report = json.loads((tmp_path / "benchmarks.json").read_text())
    assert {row["kernel"] for row in report["kernels"]} >= {"march", "mlp", "hash_interpolate + gradient"}
    assert all(row["fast_ms"] > 0 and row["reference_ms"] > 0 for row in report["kernels"])
    assert [row["value"] for row in report["growth"]] == [64, 128, 3, 8]
    assert report["threads"][0]["threads"] == report["threads"][0]["efficiency"] == 1
    assert report["overhead"][0]["bare_ms"] > 0
    assert report["methods"][0]["method"] == "smoke_3d" and report["runs"][0]["status"] == "finished"
    assert "bare_ms" in (tmp_path / "table.txt").read_text() and "bare_ms" in capsys.readouterr().out


def test_cameras_are_as_good_wherever_all_of_them_stand_together():
    truth, centre = cameras_around_ball(6, 8), torch.zeros(3)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.4, 0.1], [0.4, 0.0, 0.2], [-0.1, -0.2, 0.0]]))
    elsewhere = torch.eye(4)
    elsewhere[:3, :3], elsewhere[:3, 3] = 1.7 * turn, torch.tensor([1.0, -2.0, 0.5])
    together = replace(truth, c2w=in_other_frame(truth.c2w, elsewhere).float())
    assert max(cameras.errors(together, truth, centre).values()) < 0.1
    c2w = truth.c2w.clone()
    angle = torch.tensor(0.1)
    c2w[2, :3, :2] = c2w[2, :3, :2] @ torch.tensor([[angle.cos(), -angle.sin()], [angle.sin(), angle.cos()]])
    found = cameras.errors(replace(truth, c2w=c2w), truth, centre)
    assert found["degrees"] == pytest.approx(math.degrees(0.1) / 6, rel=1e-2) and found["moved_percent"] < 0.01


def test_an_unknown_part_is_refused(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmarks", "colonels"])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert stopped.value.code == 2 and "colonels" in capsys.readouterr().err


def test_flipped_poses_are_counted_with_and_without_the_photos_order():
    rows = capture.flips([1], count=60)
    assert len(rows) == len(capture.WALKS) and all(row["photos"] == 60 for row in rows)
    assert sum(row["in_order"] for row in rows) < sum(row["alone"] for row in rows)


def test_errors_of_a_capture_are_told_in_the_true_frame():
    layout = capture.SHEETS["six tags"]
    shifted = {tag: layout.poses[tag].copy() for tag in layout.poses}
    shifted[4][0, 3] += 1e-3
    to_first = np.linalg.inv(layout.poses[2])
    world = {tag: to_first @ pose for tag, pose in shifted.items()}
    solved = SimpleNamespace(tags=world, fixed=frozenset({2}))
    assert capture.layout_error(solved, layout) == pytest.approx(1.0)


@pytest.fixture
def few_samples(monkeypatch: pytest.MonkeyPatch):
    """Kernels' cases that take no time."""
    monkeypatch.setattr(cases, "RAYS", 64)
    monkeypatch.setattr(cases, "SAMPLES", 256)
    monkeypatch.setattr(timing, "ROUNDS", 1)


def spoil(monkeypatch: pytest.MonkeyPatch, name: str, how: Callable[[Tensor], Tensor]) -> None:
    """Spoils the version of a kernel that trainings run, and leaves the reference as it is."""
    right = getattr(kernels, name)
    monkeypatch.setattr(kernels, name, lambda *given: how(right(*given)) if kernels.fast(given[0]) else right(*given))


def test_kernels_that_agree_are_all_equal(few_samples: None):
    rows, unequal = alike.measure(CPU)
    assert unequal == [] and device.verdict(unequal) == "all equal"
    assert all(row["equal"] and row["device_ms"] > 0 and row["reference_ms"] > 0 for row in rows)
    assert {"march, unbounded", "plane_line_sum", "mark_cells", "voxel_value"} <= {row["kernel"] for row in rows}


def test_kernels_whose_value_or_gradient_is_wrong_are_named(few_samples: None, monkeypatch: pytest.MonkeyPatch):
    def refuse(x: Tensor) -> Tensor:
        raise NotImplementedError("not on\nthis device")

    spoil(monkeypatch, "hash_interpolate", lambda x: x + 0.03 * (x - x.detach()))
    spoil(monkeypatch, "spherical_harmonics", lambda x: x * (1 + 1e-3))
    spoil(monkeypatch, "points", lambda x: x * torch.nan)
    spoil(monkeypatch, "voxel_value", refuse)
    _, unequal = alike.measure(CPU)
    assert unequal == [
        "points (value, nan apart)",
        "hash_interpolate (gradient, 3.0e-2 apart)",
        "hash_interpolate_2d (gradient, 3.0e-2 apart)",
        "spherical_harmonics (value, 1.0e-3 apart)",
        "voxel_value (failed: not on this device)",
    ]
    assert device.verdict(unequal[1:2]) == "not equal: hash_interpolate (gradient, 3.0e-2 apart)"


def samples_on_two_rays(*distances: float) -> list[Tensor]:
    """As packed: those below 10 on the first ray, 10 less of the others on the second."""
    along = torch.tensor(distances, dtype=torch.float32)
    t, ray = along % 10, (along >= 10).long()
    return [t, torch.ones_like(t), ray, torch.tensor([0, int((ray == 0).sum()), len(ray)])]


def test_samples_are_compared_with_their_counterparts_on_the_same_ray():
    wanted = samples_on_two_rays(1, 2, 3, 11, 12)
    assert alike.packed(samples_on_two_rays(1, 2.00001, 3, 11, 12), wanted)[1] == 0
    assert alike.packed(samples_on_two_rays(1, 3, 11, 12), wanted) == (0, 0.2)
    assert alike.packed(samples_on_two_rays(1, 2, 3, 12), wanted) == (0, 0.2)
    assert alike.packed(samples_on_two_rays(1, 2, 3, 11, 13), wanted) == (0, 0.4)
    longer = samples_on_two_rays(1, 2, 3, 11, 12)
    longer[1][4] = 1.5
    assert alike.packed(longer, wanted) == (0.5, 0)
    longer[3][1] = 2
    assert alike.packed(longer, wanted)[1] == 1, "offsets that do not fit the rays"


def test_entries_that_are_others_count_among_those_that_are_not_zero():
    assert alike.others(torch.tensor([0, 0, 0, 3, 0]), torch.tensor([0, 0, 0, 3, 3])) == 0.5
    rows, weights = torch.arange(16).view(2, 8), torch.rand(2, 8)
    assert alike.located([rows + torch.tensor([[0], [1]]), weights + torch.tensor([[0.0], [1]])], [rows, weights]) == (
        0,
        0.5,
    )


@pytest.mark.parametrize(
    ("there", "seeds", "found"),
    [
        ([29.8], 1, []),
        ([29.5, 30.1], 2, []),
        ([29.2], 4, ["hashgrid (0.8 dB below the CPU)"]),
        ([31.0], 1, []),
        ([float("nan")], 4, ["hashgrid (nan dB below the CPU)"]),
    ],
)
def test_a_method_far_below_the_cpu_is_named_with_more_seeds_where_in_doubt(there, seeds, found, monkeypatch, tmp_path):
    def trained(overrides: list[str], kernels: str, seed: int, *rest: object) -> float:
        spoilt = "recipe=hashgrid_medium" in overrides and kernels == "auto"
        return there[min(seed, len(there) - 1)] if spoilt else 30.0

    monkeypatch.setattr(trainings, "trained", trained)
    rows, unequal = trainings.measure(CPU, 0, tmp_path)
    assert unequal == found and [row["seeds"] for row in rows] == [1, seeds, 1, 1, 1, 1, 1, 1]


def test_short_trainings_of_rays_and_of_pictures_run_with_either_version(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr(trainings, "STEPS", 2)
    monkeypatch.setattr(trainings, "SCENE", ("dataset=bricks", "dataset.size=16", "dataset.train_views=10"))
    everything = trainings.everything()
    for name in ("voxels", "hashgrid2d"):
        quality = [
            trainings.trained(everything[name], version, 0, CPU, tmp_path / name / version)
            for version in ("auto", "reference")
        ]
        assert quality[0] == pytest.approx(quality[1], abs=0.1) and quality[0] > 1
    assert capsys.readouterr().out == ""


def test_a_step_is_measured_in_time_operations_and_waits(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(steps, "WARMUP", 4)
    monkeypatch.setattr(steps, "PERIODS", 1)
    row = steps.of_method(["+experiment=smoke_3d", "dataset.size=16", "dataset.train_views=10"], CPU)
    assert row["step_ms"] > 0 and row["operations_on_average"] > row["operations"] > 20
    assert row["waits"] >= 1 and row["samples"] > row["rays"] > 0 and row["peak_memory_bytes"] > 1e6


@pytest.mark.parametrize(
    ("unequal", "last"),
    [([], "all equal"), (["march (failed: no)", "mlp (x)"], "not equal: march (failed: no), mlp (x)")],
)
def test_the_last_line_and_the_exit_code_say_what_is_not_equal(unequal, last, tmp_path, monkeypatch, capsys):
    def trained(experiment: str, overrides: list[str], *rest: object) -> dict:
        assert "device=cpu" in overrides and "budget.seconds=7.0" in overrides
        return run(CURVE, scene={"name": "bricks"}, device="cpu")

    monkeypatch.setattr(alike, "measure", lambda *_: ([{"kernel": "mlp", "equal": not unequal}], unequal[:1]))
    monkeypatch.setattr(trainings, "measure", lambda *_: ([{"method": "mlp"}], unequal[1:]))
    monkeypatch.setattr(steps, "measure", lambda *_: ([{"method": "mlp", "step_ms": 1.0}], []))
    monkeypatch.setattr(device, "train", trained)
    arguments = ["benchmarks", "device", "--device", "cpu", "--budgets", "7", "--output", str(tmp_path)]
    monkeypatch.setattr("sys.argv", arguments)
    with pytest.raises(SystemExit) as stopped:
        command.main()
    said = capsys.readouterr().out.splitlines()
    assert said[-2:] == [f"written to {tmp_path}", last] and stopped.value.code == bool(unequal)
    report = json.loads((tmp_path / "benchmarks.json").read_text())
    assert report["device"]["name"] == "cpu" and report["device steps"] == [{"method": "mlp", "step_ms": 1.0}]
    assert [row["method"] for row in report["device lego"]] == ["tensorf", "hashgrid", "voxels", "mlp"]
    assert report["device lego"][0] | {"seconds_to_27_db": 30.0, "seconds_to_30_db": None} == report["device lego"][0]
    assert "device kernels" in (tmp_path / "table.txt").read_text()


def test_a_device_that_is_not_there_is_refused(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmarks", "device", "--device", "abacus"])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert stopped.value.code == 2 and "abacus" in capsys.readouterr().err


def test_a_training_that_fails_is_named_and_the_others_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def trained(experiment: str, overrides: list[str], *rest: object) -> dict:
        if "recipe=voxels_medium" in overrides:
            raise SystemExit("benchmarks: lego failed: ['no room']")
        return run(CURVE, scene={"name": "lego"}, device="cpu")

    monkeypatch.setattr(device, "train", trained)
    rows, failed = device.lego(CPU, [], 7.0, 0, tmp_path)
    assert failed == ["voxels (its training failed)"] and "no room" in rows[2]["failed"]
    assert [row.get("scene") for row in rows] == ["lego", "lego", None, "lego"]


@pytest.mark.parametrize("kind", drawn.KINDS)
def test_pictures_are_drawn_from_their_seed_alone(kind: str, tmp_path: Path):
    first, again, other = (drawn.write_picture(kind, 48, seed, tmp_path / str(n)) for n, seed in enumerate((0, 0, 1)))
    pixels = load_picture(first)
    assert pixels.shape == (48, 48, 3) and pixels.float().std() > 5
    assert first.read_bytes() == again.read_bytes() != other.read_bytes()
