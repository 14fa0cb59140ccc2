"""Choosing a model chooses its learning rate, whatever an experiment chose before, and takes its recipe's name off."""

from pathlib import Path

import pytest

from nerf_lightning.config.compose import composed


@pytest.mark.parametrize(
    ("overrides", "rate", "recipe"),
    [
        (["+experiment=lego"], 0.05, "tensorf_medium"),
        (["+experiment=lego", "model=mlp"], 5e-4, None),
        (["+experiment=lego", "model=mlp", "optimizer=adamw"], 5e-4, None),
        (["+experiment=lego", "recipe=mlp_small"], 1e-2, "mlp_small"),
        (["model=voxels"], 0.1, None),
        (["model=voxels", "optimizer.lr=3"], 3, None),
    ],
)
def test_a_model_brings_its_rate(overrides: list[str], rate: float, recipe: str | None, tmp_path: Path):
    cfg = composed(overrides, tmp_path)
    assert (cfg.optimizer.lr, cfg.recipe) == (rate, recipe)
