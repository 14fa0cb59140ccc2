"""Choosing a model chooses its learning rate, whatever an experiment chose before, and takes its recipe's name off."""

from pathlib import Path

import pytest

from nerf_lightning.config.compose import compose_config


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
def test_model_sets_learning_rate(overrides: list[str], rate: float, recipe: str | None, tmp_path: Path):
    cfg = compose_config(overrides, tmp_path)
    assert (cfg.optimizer.lr, cfg.recipe) == (rate, recipe)
