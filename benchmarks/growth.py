"""How the time of a step grows: with samples a step, with the number of photos, with their size."""

import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import median

import torch

from benchmarks.bare import bare_loop
from benchmarks.setup import built
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.resize import resize_views

STEPS, FROM = 300, 150
SAMPLES = (8192, 16384, 32768, 65536)
VIEWS = (10, 100, 1000)
SIDES = (50, 100, 200)
DISTINCT = 10
"""Photos that are repeated to make more of them: the content, and with it the work, stays the same."""


def step_ms(overrides: list[str], views: int | None = None, side: int | None = None) -> float:
    """Median milliseconds of a step, of the scene with so many training photos or of so many pixels."""
    with tempfile.TemporaryDirectory() as folder:
        cfg, data, system = built(overrides, Path(folder))
    train = data.scene.train
    if side is not None:
        train = resize_views(train, side)
    if views is not None:
        chosen = torch.arange(views) % DISTINCT
        train = Views(train.images[chosen], train.cameras[chosen])
    scene = replace(data.scene, train=train)
    data = RayDataModule(scene, rays=data.rays, samples=data.samples, seed=cfg.seed)
    return 1e3 * median(bare_loop(system, data, STEPS)[FROM:])


def measure(overrides: list[str], rounds: int = 3) -> list[dict[str, float | str]]:
    """Milliseconds of a step along each axis: medians of rounds that alternate between the points."""
    points: list[tuple[str, int, dict]] = [
        *(("samples a step", n, {"overrides": [*overrides, f"dataset.samples={n}"]}) for n in SAMPLES),
        *(("photos", n, {"overrides": overrides, "views": n}) for n in VIEWS),
        *(("pixels along a side", n, {"overrides": overrides, "side": n}) for n in SIDES),
    ]
    times: list[list[float]] = [[] for _ in points]
    for _ in range(rounds):
        for collected, (_, _, settings) in zip(times, points, strict=True):
            collected.append(step_ms(**settings))
    return [
        {"axis": axis, "value": value, "step_ms": median(collected)}
        for collected, (axis, value, _) in zip(times, points, strict=True)
    ]
