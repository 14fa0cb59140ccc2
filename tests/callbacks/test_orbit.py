"""The orbit takes no longer than training, unless it is asked for."""

from pathlib import Path

import imageio.v3 as imageio
import pytest

from nerf_lightning.callbacks.orbit import fit_orbit
from nerf_lightning.config.compose import composed
from nerf_lightning.training.train import train


@pytest.mark.parametrize(
    ("share", "expected"),
    [(1.0, (60, 1.0)), (0.5, (30, 1.0)), (0.2, (12, 1.0)), (0.05, (12, 0.5)), (1e-6, (12, 0.25))],
)
def test_fit_orbit_little_time_lowers_frames_then_size(share: float, expected: tuple[int, float]):
    assert fit_orbit(60, share) == pytest.approx(expected)


@pytest.mark.parametrize(("asked", "frames", "width"), [("null", 12, 8), ("3", 3, 32)])
def test_orbit_slow_field_is_small(asked: str, frames: int, width: int, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setattr("nerf_lightning.callbacks.budget.Budget.render_seconds", lambda self, step: 1e-9)
    off = ["callbacks.heldout=null", "callbacks.snapshots=null", "~logger"]
    train(composed(["+experiment=smoke_3d", "budget.steps=2", f"callbacks.orbit.frames={asked}", *off], tmp_path))
    assert imageio.imread(tmp_path / "orbit.gif").shape[0] == frames
    assert (f"12 frames of {width}x{width}" in capsys.readouterr().out) == (asked == "null")
