"""The orbit takes no longer than training, unless it is asked for."""

from pathlib import Path

import imageio.v3 as imageio
import pytest

from nerf_lightning.config.compose import composed
from nerf_lightning.training.train import train


@pytest.mark.parametrize(("asked", "frames", "side"), [("null", 60, 3), ("3", 3, 32)])
def test_orbit_slow_field_is_small(asked: str, frames: int, side: int, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("nerf_lightning.callbacks.budget.Budget.render_seconds", lambda self, step: 1e-9)
    off = ["callbacks.heldout=null", "callbacks.snapshots=null", "~logger"]
    train(composed(["+experiment=smoke_3d", "budget.steps=2", f"callbacks.orbit.frames={asked}", *off], tmp_path))
    assert imageio.imread(tmp_path / "orbit.gif").shape[0] == frames
    assert (f"60 frames of {side}x{side}" in capsys.readouterr().out) == (asked == "null")
