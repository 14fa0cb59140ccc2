"""Early stopping at a plateau."""

import json
import math
from pathlib import Path

import pytest

from nerf_lightning.callbacks.early_stopping import FIRST_MEASUREMENT, PlateauDetector
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import save_npz
from nerf_lightning.synthetic.objects import PILE, make_object_scene
from nerf_lightning.training.train import train


def find_plateau(plateau: PlateauDetector, quality, until: float = 1.0) -> float | None:
    """Fraction spent at the first plateau along a PSNR curve."""
    spent = FIRST_MEASUREMENT
    while spent <= until:
        if plateau.is_due(spent) and plateau.add_measurement(spent, quality(spent)):
            return spent
        spent *= 1.01
    return None


@pytest.mark.parametrize("slope", [0.5, 2.0])
def test_predict_gain_logarithmic_curve_matches_slope(slope: float):
    plateau = PlateauDetector(0.01)
    assert find_plateau(plateau, lambda spent: 20 + slope * math.log(spent)) is None
    assert plateau.predict_gain(2) == pytest.approx(slope * math.log(2))


def test_plateau_detector_saturating_curve_reports_plateau():
    """20 - 1 / spent dB: its slope over the logarithm is 1 / spent, so a factor of 1.5 brings 0.4 / spent."""
    spent = find_plateau(PlateauDetector(8.0), lambda spent: 20 - 1 / spent)
    assert spent is not None and math.log(1.5) / 8 < spent < 2.5 * math.log(1.5) / 8
    assert find_plateau(PlateauDetector(0.2), lambda spent: 20 - 1 / spent) is None


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    save_npz(make_object_scene(PILE, size=16, views=8, held_out=2), tmp_path / "scene.npz")
    return tmp_path / "scene.npz"


def run(scene: Path, folder: Path, *overrides: str) -> dict:
    given = ["dataset=photos", f"dataset.path={scene}", "recipe=tensorf_small"]
    given += ["model.max_resolution=16", "model.base_resolution=8"]
    given += ["budget.steps=600", "threads=1", "callbacks.orbit=null", "callbacks.snapshots.steps=[]", "~logger"]
    train(compose_config([*given, *overrides], folder))
    return json.loads((folder / "results.json").read_text())


def test_budget_patience_at_plateau_ends_training_early(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    early = run(scene, tmp_path / "early", "budget.patience=2")
    assert early["status"] == "finished" and early["steps"] < 500
    plateau = early["plateau"]
    assert 0 < plateau["step"] < early["steps"] < 1.4 * plateau["step"], "a short cooling down follows"
    assert 0 <= plateau["rest_db"] < 10
    assert "cooling down" in capsys.readouterr().out
