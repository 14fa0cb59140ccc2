"""The orbit takes no longer than training."""

from pathlib import Path

import imageio.v3 as imageio

from nerf_lightning.config.compose import compose_config
from nerf_lightning.training.train import train


def test_orbit_slow_field_renders_small_frames(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("nerf_lightning.callbacks.budget.Budget.render_allowance_seconds", lambda self, step: 1e-9)
    off = ["callbacks.validation=null", "callbacks.snapshots=null", "callbacks.orbit.frames=3", "~logger"]
    train(compose_config(["+experiment=smoke_3d", "budget.steps=2", *off], tmp_path))
    frames, height, _, _ = imageio.imread(tmp_path / "orbit.gif").shape
    assert frames == 3 and height < 200, "3 pixels, magnified, and a caption"
