"""Runs become points: what belongs together, what does not, which of them no other beats."""

import math
import random

import numpy as np
import pandas as pd

from nerf_lightning.comparison.points import compute_points, find_frontier, find_median_run
from tests.helpers.run_results import MakeRun


def test_compute_points_seeds_of_one_configuration_are_one_point(make_run: MakeRun):
    runs = [make_run(f"s{seed}", seed=seed, psnr=psnr) for seed, psnr in enumerate((29.0, 31.0, 30.5))]
    ((_, points),) = compute_points(runs)
    (point,) = points.itertuples()
    assert (point.label, point.psnr, point.psnr_min, point.psnr_max, point.collapsed) == ("grid", 30.5, 29.0, 31.0, 0)
    assert (point.train_seconds, point.render_seconds, point.bytes) == (5.01, 0.1, 40_000)
    assert find_median_run(point) is runs[2]
    assert point.options["model.width"] == 16
    assert not [key for key in point.options if "seed" in key or "path" in key or key.startswith("callbacks")]


def test_compute_points_options_that_differ_label_points(make_run: MakeRun):
    narrow, wide = ({"model": {"_target_": "fields.grid", "width": width, "depth": 2}} for width in (16, 64))
    longer = {"budget": {"steps": 2000, "seconds": None}}
    configs = {"a": narrow, "b": wide, "c": narrow | longer, "d": {"recipe": "tiny"}}
    ((_, points),) = compute_points([make_run(name, config) for name, config in configs.items()])
    assert set(points["label"]) == {
        "grid, width 16, seconds 5", "grid, width 64, seconds 5", "grid, width 16, steps 2000", "tiny",
    }  # fmt: skip


def test_compute_points_groups_by_conditions_largest_first(make_run: MakeRun):
    scene = {"name": "other", "sha256": "cd" * 32, "views": {"train": 9, "val": 2}, "resolution": [8, 6]}
    machine = {"processor": "slide rule", "cores": 2, "accelerator": None}
    runs = [
        *(make_run("scene", scene=scene), make_run("a", psnr=20.0), make_run("b", {"model": {"width": 1}})),
        make_run("white", background=[1.0, 1.0, 1.0]),
        *(make_run("machine", machine=machine), make_run("threads", threads=1)),
        make_run("gpu", device="cuda:1", machine={"accelerator": "H100"}),
        make_run("unknown", machine=None, background="nothing", scene="toy"),
    ]
    found = compute_points(runs)
    assert [len(points) for _, points in found] == [2, 1, 1, 1, 1, 1, 1]
    assert found[0][0] == (
        "toy", "8x6", "9 training and 2 held-out views", "black background", "abacus, 2 threads on 2 cores", "abababab",
    )  # fmt: skip


def test_compute_points_collapsed_seed_counts_as_worst(make_run: MakeRun):
    good = [make_run(f"s{seed}", seed=seed, psnr=30.0 + seed) for seed in range(2)]
    collapsed = make_run("collapsed", seed=2, psnr=9.8, status="collapsed")
    ((_, points),) = compute_points([*good, collapsed])
    (point,) = points.itertuples()
    assert (point.psnr, point.psnr_min, point.collapsed) == (30.0, -math.inf, 1)
    assert find_median_run(point) is good[0]
    assert compute_points([good[0], collapsed]) == [], "of two runs one is left"


def dominated(i: int, costs: list[float], gains: list[float]) -> bool:
    others = zip(costs, gains, strict=True)
    return any(c <= costs[i] and g >= gains[i] and (c < costs[i] or g > gains[i]) for c, g in others)


def test_find_frontier_matches_brute_force():
    chance = random.Random(0)
    for count in (1, 4, 40):
        for _ in range(20):
            costs, gains = ([float(chance.randint(1, 9)) for _ in range(count)] for _ in range(2))
            found = find_frontier(pd.Series(costs), pd.Series(gains))
            assert sorted(found) == [i for i in range(count) if not dominated(i, costs, gains)]
            assert [costs[i] for i in found] == sorted(costs[i] for i in found)
    assert list(find_frontier(pd.Series([np.nan, 2.0]), pd.Series([9.0, 1.0]))) == [1], "an unknown cost is on none"


def test_compute_points_frontier_ignores_timing_noise(make_run: MakeRun):
    kinds = {"a": (5.01, 25.0), "b": (5.04, 30.0), "c": (9.0, 29.0)}
    runs = [make_run(n, {"recipe": n}, train_seconds=seconds, psnr=psnr) for n, (seconds, psnr) in kinds.items()]
    ((_, points),) = compute_points(runs)
    fronts = dict(zip(points["label"], points["frontier"], strict=True))
    assert fronts == {"b": "train_seconds render_seconds bytes", "c": "", "a": ""}
