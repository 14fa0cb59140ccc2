"""Runs become points: what belongs together, what does not, and what a point says."""

import math

import pytest
from made_runs import MakeRun

from nerf_lightning.chart.points import budget_of, points_of
from nerf_lightning.chart.setting import setting_of
from nerf_lightning.runs.index import read_run


def test_seeds_of_one_configuration_are_one_point(make_run: MakeRun):
    runs = [make_run(f"s{seed}", seed=seed, psnr=psnr) for seed, psnr in enumerate((29.0, 31.0, 30.5))]
    (point,) = points_of(runs)
    assert (point.psnr, point.worst, point.best, point.seeds, point.lost) == (30.5, 29.0, 31.0, 3, 0)
    assert point.typical is runs[2]
    assert (point.seconds, point.render, point.size) == (5.01, 0.1, 40_000)
    assert point.label == "grid, 5 s"
    assert point.configuration["model.width"] == 16
    assert not [key for key in point.configuration if "seed" in key or "path" in key or key.startswith("callbacks")]


def test_other_options_are_other_points_named_by_what_differs(make_run: MakeRun):
    narrow, wide = ({"model": {"_target_": "fields.grid", "width": width, "depth": 2}} for width in (16, 64))
    budget = {"budget": {"steps": 2000, "seconds": None, "default": {"seconds": 90}}}
    runs = [
        make_run("a", narrow),
        make_run("b", wide),
        make_run("c", narrow | budget),
        make_run("d", {"recipe": "tiny"}),
    ]
    assert [point.label for point in points_of(runs)] == [
        "grid, width 16, 5 s", "grid, width 64, 5 s", "grid, width 16, 2000 steps", "tiny, 5 s",
    ]  # fmt: skip


def test_other_settings_are_apart_and_the_fullest_comes_first(make_run: MakeRun):
    scene = {"name": "other", "sha256": "cd" * 32, "views": {"train": 9, "val": 2}, "resolution": [8, 6]}
    machine = {"processor": "slide rule", "cores": 2, "accelerator": None}
    runs = [
        make_run("scene", scene=scene),
        make_run("a", psnr=20.0),
        make_run("b", {"model": {"width": 1}}),
        make_run("white", background=[1.0, 1.0, 1.0]),
        make_run("machine", machine=machine),
        make_run("threads", threads=1),
        make_run("old", machine=None, background="nothing", scene="toy"),
    ]
    points = points_of(runs)
    assert len({point.setting for point in points}) == 6
    assert points[0].setting == points[1].setting
    words = [point.setting.words() for point in points[1:]]
    assert (
        words[0]
        == "toy 8x6 (abababab), 9 training and 2 held-out views, black background; abacus, 2 threads on 2 cores"
    )
    assert sum("unknown machine" in one for one in words) == 1 and sum("white" in one for one in words) == 1


def test_charts_keep_devices_apart(make_run: MakeRun):
    machine = {"processor": "abacus", "cores": 2, "accelerator": None}
    card = machine | {"accelerator": "H100"}
    runs = [
        make_run("cpu", {"device": "auto", "trainer": {"accelerator": "auto"}}),
        make_run("cpu_named", {"device": "cpu", "trainer": {"accelerator": "cpu"}}, seed=1),
        make_run("cuda", device="cuda:0", machine=card),
        make_run("second_card", device="cuda:1", machine=card),
        make_run("another_card", device="cuda:0", machine=card | {"accelerator": "A100"}),
        make_run("nameless", device="mps:0", machine=machine),
        make_run("nameless_cuda", device="cuda:0", machine=machine),
        make_run("unknown", device="cuda:0", machine=None),
    ]
    told = [setting_of(run).machine for run in runs]
    assert told[0] == told[1] == "abacus, 2 threads on 2 cores"
    assert told[2] == told[3] == "H100 (cuda)" and told[4] == "A100 (cuda)"
    assert len(set(told)) == 6
    assert len(points_of(runs[:2])) == 1, "seeds of one configuration, however the device was named"


def test_a_lost_seed_counts_as_the_worst(make_run: MakeRun):
    good = [make_run(f"s{seed}", seed=seed, psnr=30.0 + seed) for seed in range(2)]
    collapsed = make_run("collapsed", seed=2, psnr=9.8, status="collapsed")
    (point,) = points_of([*good, collapsed])
    assert (point.psnr, point.worst, point.lost) == (30.0, 9.8, 1)
    failed = make_run("failed", seed=3, psnr=None, train_seconds=None, scene=None, curve=[], status="failed")
    (point,) = points_of([*good, make_run("third", seed=2, psnr=32.0), failed])
    assert (point.psnr, point.worst, point.lost) == (30.5, -math.inf, 1)
    assert points_of([good[0], collapsed, failed]) == [], "of three runs one is left"


@pytest.mark.parametrize("changes", [{"psnr": None}, {"psnr": "high"}, {"train_seconds": 0}, {"train_seconds": [1]}])
def test_a_run_without_figures_makes_no_point(changes: dict, make_run: MakeRun):
    assert points_of([make_run("a", **changes)]) == []


def test_runs_whose_options_are_unknown_stay_apart(make_run: MakeRun):
    runs = [make_run(name) for name in "ab"]
    for run in runs:
        (run.folder / "config.yaml").write_text("[")
    assert [len(point.runs) for point in points_of([read_run(run.folder) for run in runs])] == [1, 1]


@pytest.mark.parametrize(
    ("budget", "words"),
    [
        ({"steps": None, "seconds": 2.5, "default": {"steps": 9}}, "2.5 s"),
        ({"steps": 100, "seconds": 60, "default": {"seconds": 90}}, "60 s, 100 steps"),
        ({"steps": None, "seconds": None, "default": {"steps": 500, "seconds": None}}, "500 steps"),
        ({}, ""),
    ],
)
def test_budgets_in_words(budget: dict, words: str, make_run: MakeRun):
    assert budget_of(make_run("a", {"budget": budget})) == words
