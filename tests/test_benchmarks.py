import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import __main__ as command
from benchmarks import capture, cases, growth, methods, overhead

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


def test_one_command_writes_table_and_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr(cases, "RAYS", 16)
    monkeypatch.setattr(cases, "SAMPLES", 64)
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
    assert report["overhead"][0]["bare_ms"] > 0
    assert report["methods"][0]["method"] == "smoke_3d" and report["runs"][0]["status"] == "finished"
    assert "bare_ms" in (tmp_path / "table.txt").read_text() and "bare_ms" in capsys.readouterr().out


def test_an_unknown_part_is_refused(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.setattr("sys.argv", ["benchmarks", "colonels"])
    with pytest.raises(SystemExit) as stopped:
        command.main()
    assert stopped.value.code == 2 and "colonels" in capsys.readouterr().err


def test_flipped_poses_are_counted_with_and_without_the_photos_order():
    rows = capture.flips([1], count=60)
    assert len(rows) == 3 and all(row["photos"] == 60 for row in rows)
    assert sum(row["in_order"] for row in rows) < sum(row["alone"] for row in rows)


def test_errors_of_a_capture_are_told_in_the_true_frame():
    layout = capture.SHEETS["six tags"]
    shifted = {tag: layout.poses[tag].copy() for tag in layout.poses}
    shifted[4][0, 3] += 1e-3
    to_first = np.linalg.inv(layout.poses[2])
    world = {tag: to_first @ pose for tag, pose in shifted.items()}
    solved = SimpleNamespace(tags=world, fixed=frozenset({2}))
    assert capture.layout_error(solved, layout) == pytest.approx(1.0)
