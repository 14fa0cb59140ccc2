"""Recommendations and remarks, on points made by hand."""

import pytest
from made_runs import MakeRun

from nerf_lightning.chart.advice import advice, in_bytes
from nerf_lightning.chart.comparison import compare
from nerf_lightning.chart.notes import remarks, troubles
from nerf_lightning.chart.points import points_of


@pytest.fixture
def runs(make_run: MakeRun):
    """Best but slow, nearly as good and quick, small, poor."""
    kinds = {
        "slow": {"psnr": 33.0, "train_seconds": 60.1, "artifact_bytes": 9e6},
        "quick": {"psnr": 32.6, "train_seconds": 15.0, "artifact_bytes": 8e6},
        "small": {"psnr": 32.1, "train_seconds": 60.0, "artifact_bytes": 3e5},
        "poor": {"psnr": 20.0, "train_seconds": 5.0, "artifact_bytes": 1e5},
    }
    return [make_run(name, {"recipe": name}, **changes) for name, changes in kinds.items()]


def test_advice(runs):
    best, fastest, within, smallest = advice(points_of(runs), 0.5, 15, 1.0)
    assert best.startswith("Best: slow, 5 s: 33.00 dB (one seed) after 60.1 s, 9.0 MB")
    assert "within 0.5 dB" in fastest and ": quick" in fastest
    assert "within 15 s" in within and ": quick" in within
    assert "within 1 dB" in smallest and ": small" in smallest and "300 kB" in smallest
    assert ": slow" in advice(points_of(runs), 0.3, 15, 1.0)[1]
    assert ": poor" in advice(points_of(runs), 0.5, 5, 1.0)[2]
    assert "Nothing trained" in advice(points_of(runs), 0.5, 1, 1.0)[2]
    assert ": quick" in advice(points_of(runs), 0.5, 15, 0.5)[3]


def test_advice_names_lost_seeds(make_run: MakeRun):
    runs = [make_run(f"s{seed}", seed=seed, psnr=30.0 - seed) for seed in range(2)]
    assert "worst of 2 seeds 29.00" in advice(points_of(runs), 0.5, 15, 1)[0]
    lost = make_run("lost", seed=2, psnr=9.0, status="collapsed", diagnosis="no density")
    assert "1 of 3 runs lost" in advice(points_of([*runs, lost]), 0.5, 15, 1)[0]
    assert troubles([*runs, lost]) == ["lost: collapsed: no density"]


@pytest.mark.parametrize(("size", "words"), [(1.25e6, "1.2 MB"), (340_400, "340 kB"), (20, "0 kB")])
def test_bytes_in_words(size: float, words: str):
    assert in_bytes(size) == words


def test_a_busy_machine_is_said(make_run: MakeRun):
    calm, busy = make_run("calm"), make_run("busy", {"recipe": "x"}, load={"own": 1.2, "others": 0.8})
    points = points_of([calm, busy])
    (said,) = remarks(points, [])
    assert "busy" in said and "1 of 2 runs" in said and "40%" in said
    free = make_run("free", {"recipe": "y"}, threads=1, load={"own": 1.0, "others": 0.8})
    assert remarks(points_of([calm, free]), []) == [], "others used the core that the run left free"


def test_few_seeds_unknown_load_and_versions_are_said(make_run: MakeRun):
    old = make_run("old", {"recipe": "x"}, load=None, versions={"nerf_lightning": "0"}, render_seconds_per_view=None)
    points = points_of([make_run("new"), old])
    told = " ".join(remarks(points, points[:1]))
    assert "1 of 2 runs the load" in told
    assert "fewer than 3 seeds: grid, 5 s." in told
    assert "different versions of nerf_lightning: 0, 1" in told
    assert "Without a rendering time: x, 5 s" in told


def test_frontiers_of_a_comparison(runs):
    (one,) = compare(runs, [], 0.5, 15, 1.0)
    labels = [point.label.split(",")[0] for point in one.points]
    assert labels == ["poor", "quick", "small", "slow"]
    assert one.frontiers == {"training": [0, 1, 3], "rendering": [3]}, "all render alike, so the best alone is left"
    assert one.on_frontier(3) == ["training", "rendering"] and one.on_frontier(2) == []


def test_seconds_that_differ_by_the_clocks_noise_are_equal(make_run: MakeRun):
    runs = [
        make_run("a", {"recipe": "a"}, train_seconds=5.01, psnr=25.0),
        make_run("b", {"recipe": "b"}, train_seconds=5.04),
    ]
    (one,) = compare(runs, [], 0.5, 15, 1.0)
    assert one.frontiers["training"] == [1]
