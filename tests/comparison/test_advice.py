import pandas as pd
import pytest

from nerf_lightning.comparison.advice import list_caveats, recommend
from nerf_lightning.comparison.points import compute_points
from tests.helpers.run_results import MakeRun


@pytest.fixture
def points(make_run: MakeRun) -> pd.DataFrame:
    """Best but slow, nearly as good and quick, small, poor."""
    kinds = {
        "slow": {"psnr": 33.0, "train_seconds": 60.1, "artifact_bytes": 9e6},
        "quick": {"psnr": 32.6, "train_seconds": 15.0, "artifact_bytes": 8e6},
        "small": {"psnr": 32.1, "train_seconds": 60.0, "artifact_bytes": 3e5},
        "poor": {"psnr": 20.0, "train_seconds": 5.0, "artifact_bytes": 1e5},
    }
    ((_, found),) = compute_points([make_run(name, {"recipe": name}, **changes) for name, changes in kinds.items()])
    return found


def test_recommend_merges_sentences_of_same_point(points: pd.DataFrame):
    assert recommend(points, 1.0, 15) == [
        "Best: slow: 33.00 dB (one seed) after 60.1 s, 9 MB.",
        "Fastest within 1 dB of the best and best after at most 15 s of training: quick: 32.60 dB (one seed)"
        " after 15 s, 8 MB.",
        "Smallest within 1 dB of the best: small: 32.10 dB (one seed) after 60 s, 300 kB.",
    ]


def test_recommend_reports_seed_range_and_collapsed_runs(make_run: MakeRun):
    runs = [make_run(f"s{seed}", seed=seed, psnr=30.0 - seed) for seed in range(2)]
    assert "29.00 to 30.00 over 2 seeds" in recommend(compute_points(runs)[0][1], 0.5, 15)[0]
    lost = make_run("lost", seed=2, psnr=9.0, status="collapsed")
    assert "1 of 3 runs collapsed" in recommend(compute_points([*runs, lost])[0][1], 0.5, 15)[0]


def test_list_caveats_reports_busy_machine_and_few_seeds(make_run: MakeRun):
    busy = make_run("busy", {"recipe": "x"}, psnr=20.0, load={"own": 1.2, "others": 0.8})
    free = make_run("free", {"recipe": "y"}, psnr=10.0, threads=2, load={"own": 1.0, "others": 0.02})
    caveats = list_caveats(compute_points([make_run("calm"), busy, free])[0][1])
    assert len(caveats) == 2 and "40%" in caveats[0] and "of x." in caveats[0]
    assert caveats[1] == "On a frontier with fewer than 3 seeds: grid."
