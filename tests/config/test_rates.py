"""Choosing a model chooses its learning rate, whatever an experiment chose before."""

from pathlib import Path

import pytest

from nerf_lightning.config.compose import composed


@pytest.mark.parametrize(
    ("overrides", "rate"),
    [
        (["+experiment=lego"], 0.05),
        (["+experiment=lego", "model=mlp"], 5e-4),
        (["+experiment=lego", "model=mlp", "optimizer=adamw"], 5e-4),
        (["+experiment=lego", "recipe=mlp_medium"], 1e-2),
        (["model=voxels"], 0.1),
        (["model=voxels", "optimizer.lr=3"], 3),
    ],
)
def test_a_model_brings_its_rate(overrides: list[str], rate: float, tmp_path: Path):
    assert composed(overrides, tmp_path).optimizer.lr == rate
