"""Supported precisions train every kind of field; tests of the command line cover the others."""

import math
from pathlib import Path

import pytest

from nerf_lightning.config.build import PRECISIONS
from nerf_lightning.config.compose import compose_config
from nerf_lightning.training.train import train

SCENE = ("dataset.size=16", "dataset.train_views=3", "dataset.val_views=1", "dataset.rays=32", "sampler.samples=16")
PICTURE = ("+experiment=picture", "dataset.max_side=16")


@pytest.mark.filterwarnings("ignore:You passed")  # on a CPU Lightning takes bf16-mixed for 16-mixed, and says so
@pytest.mark.parametrize(
    ("model", "precision"),
    [("hashgrid", "16-mixed"), *((m, "bf16-mixed") for m in ("hashgrid", "tensorf", "mlp", "voxels", "hashgrid2d"))],
)
def test_train_mixed_precision_learns(model: str, precision: str, tmp_path: Path):
    base = PICTURE if model == "hashgrid2d" else SCENE
    small = ["dataset.seed=0", "budget.steps=2", "callbacks=null", "logger=null", f"model={model}"]
    assert precision in PRECISIONS
    cfg = compose_config([*base, *small, f"trainer.precision={precision}"], tmp_path)
    assert math.isfinite(train(cfg, folder=tmp_path))
