"""Rendering takes at most as long as training, and the time left that is shown comes true."""

import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console
from torch import Tensor

from nerf_lightning.callbacks.render_timer import MIN_RENDER_FRACTION, RenderTimer, allocate_max_min_fair
from nerf_lightning.cameras import Rays
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import Views
from nerf_lightning.renderer import RenderOutput
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.system import NeRF3D, StepStats
from nerf_lightning.training.train import train


@dataclass
class TrainingLog:
    """What a run showed, and the true values."""

    times: list[tuple[float, float]]
    """Seconds left, as shown and as they really were."""
    subjects: set[str]
    """Subjects shown, with N for each number."""
    rendering: float
    """Seconds of rendering."""
    results: dict[str, Any]


@pytest.mark.parametrize(
    ("costs", "allowance", "expected"),
    [
        ({"final": 10.0, "orbit": 5.0}, 20.0, {"final": 10.0, "orbit": 5.0}),
        ({"final": 10.0, "orbit": 50.0}, 20.0, {"final": 10.0, "orbit": 10.0}),
        ({"final": 100.0, "orbit": 50.0}, 31.0, {"final": 30.0, "orbit": 1.0}),
        ({"curve": 1.0, "snapshots": 50.0, "orbit": 60.0}, 21.0, {"curve": 1.0, "snapshots": 10.0, "orbit": 10.0}),
        ({"final": 0.0, "orbit": 5.0}, -3.0, {"final": 0.0, "orbit": 0.0}),
    ],
)
def test_allocate_max_min_fair_unused_time_goes_to_others(costs: dict, allowance: float, expected: dict):
    shares = allocate_max_min_fair(costs, {job: 30.0 if job == "final" else 1.0 for job in costs}, allowance)
    assert shares == pytest.approx(expected, abs=2 * MIN_RENDER_FRACTION * max(costs.values()))


def test_render_timer_seconds_per_pixel_follow_last_views(clock):
    render_timer = RenderTimer()
    render_timer.add_timing(1 << 14, 2.0 * (1 << 14))
    render_timer.add_timing(10, 1000.0)
    assert render_timer.seconds_per_pixel == pytest.approx(2.0, abs=0.1), "few pixels say little"
    render_timer.add_timing(1 << 14, 1.0 * (1 << 14))
    assert render_timer.seconds_per_pixel == pytest.approx(1.3, abs=0.1)
    with render_timer.measure("orbit"):
        clock.wait(7)
        assert render_timer.subject == "orbit"
    assert render_timer.seconds == 7 and render_timer.subject == ""


@pytest.fixture
def simulated(
    clock: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Callable[[int, float, float], TrainingLog]:
    """Trains for 180 s of a fake clock that steps (1 s each) and rendered pixels advance."""
    monkeypatch.setattr(time, "monotonic", clock)
    monkeypatch.setattr("nerf_lightning.training.train.warm_up", lambda *given: None)

    def training_step(self: NeRF3D, batch: Any, batch_idx: int) -> Tensor:
        clock.wait(1.0)
        self.stats = StepStats(torch.tensor(0.01), 100, 100)
        return sum(parameter.sum() for parameter in self.parameters())

    def run(side: int, pixel_seconds: float, fog: float) -> TrainingLog:
        """Args: of held-out photos; of a pixel, and how many times that at first."""
        small = bricks(size=16, train_views=6, val_views=8)
        cameras = small.val.cameras.resize((side, side))
        photos = torch.zeros(8 * side * side, 3, dtype=torch.uint8)
        scene = replace(small, val=Views(photos, cameras), orbit=small.orbit.resize((side, side)))
        rendering = 0.0

        def render(self: NeRF3D, rays: Rays, **given: Any) -> RenderOutput:
            nonlocal rendering
            seconds = len(rays) * pixel_seconds * (fog if self.state.progress < 0.03 else 1.0)
            clock.wait(seconds)
            rendering += seconds
            return RenderOutput(torch.rand(len(rays), 3), torch.ones(len(rays)), torch.ones(len(rays)))

        lines: list[tuple[float, str]] = []
        off = [f"callbacks.{name}=null" for name in ("recovery", "checkpoints")]
        options = ["budget.seconds=180", "callbacks.orbit.frames=60", "callbacks.progress.every_seconds=1", "~logger"]
        with monkeypatch.context() as patch:
            patch.setattr(NeRF3D, "training_step", training_step)
            patch.setattr(NeRF3D, "render", render)
            patch.setattr(Console, "print", lambda self, *said, **given: lines.append((clock.now, said[0])))
            train(compose_config(["+experiment=smoke_3d", *options, *off], tmp_path), scene=scene)
        found = re.compile(r"left (\d+):(\d\d)(?:: (.*))?$")
        left = [(at, match) for at, line in lines if (match := found.search(line))]
        times = [(60 * int(match[1]) + int(match[2]), clock.now - at) for at, match in left]
        subjects = {re.sub(r"\d+", "N", match[3]) for _, match in left if match[3]}
        return TrainingLog(times, subjects, rendering, json.loads((tmp_path / "results.json").read_text()))

    return run


@pytest.mark.parametrize(
    ("side", "pixel_seconds", "fog", "seconds", "rows"),
    [
        # 10 snapshots, 5 times 8 views, 8 views, 60 frames of the orbit, and the first view.
        (32, 2e-5, 4.0, 119 * 32 * 32 * 2e-5, 1.0),
        (512, 2e-4, 1.0, 180.0, 0.25),  # the held-out views take 419 s
    ],
)
def test_rendering_slow_field_takes_at_most_training_time(
    side: int, pixel_seconds: float, fog: float, seconds: float, rows: float, simulated: Callable[..., TrainingLog]
):
    log = simulated(side, pixel_seconds, fog)
    assert log.rendering == pytest.approx(seconds, rel=0.1)
    assert log.results["rows_measured"] == pytest.approx(rows, abs=0.01)
    assert max(true for _, true in log.times) > 170, "shown from the tenth second on"
    assert not [(left, true) for left, true in log.times if abs(left - true) > max(0.25 * true, 2.0)]
    if rows < 1:
        names = {"snapshot", "held-out view N of N", "orbit, frame N of N"}
        assert names <= log.subjects
