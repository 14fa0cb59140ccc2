"""How the time of a step grows: with samples a step, with the number of photos, with their size."""

import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median

import torch

from benchmarks.bare import bare_step
from benchmarks.setup import built
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.resize import resize_views

WARMUP, BLOCK, ROUNDS = 300, 32, 10
"""Steps before the first that counts; steps in a row at one point; how often each point has its turn."""
PROGRESS = 0.5
"""The field has its full size from here on."""
SAMPLES = (8192, 16384, 32768, 65536)
VIEWS = (10, 100, 1000)
SIDES = (50, 100, 200)
DISTINCT = 10
"""Photos that are repeated to make more of them: the content, and with it the work, stays the same."""


def repeated(train: Views, count: int) -> Views:
    chosen = torch.arange(count) % DISTINCT
    return train[torch.as_tensor(chosen)]


def points(data: RayDataModule, seed: int) -> list[tuple[str, int, RayDataModule]]:
    """Axis, value on it, and the data that stands for it."""

    def variant(train: Views, samples: int | None) -> RayDataModule:
        return RayDataModule(replace(data.scene, train=train), rays=data.rays, samples=samples, seed=seed)

    train = data.scene.train
    return [
        *(("samples a step", n, variant(train, n)) for n in SAMPLES),
        *(("photos", n, variant(repeated(train, n), data.samples)) for n in VIEWS),
        *(("pixels along a side", n, variant(resize_views(train, n), data.samples)) for n in SIDES),
    ]


def measure(overrides: list[str]) -> list[dict[str, float | str]]:
    """Milliseconds of a step along each axis, all measured on one field in training, block after block in turn.

    `ratio` is that to the axis's first point, the median over rounds.
    """
    with tempfile.TemporaryDirectory() as folder:
        cfg, data, system = built(overrides, Path(folder))
    optimizer = system.configure_optimizers()
    everything = points(data, cfg.seed)

    def block(data: RayDataModule, first: int, steps: int) -> float:
        times = [bare_step(system, data, optimizer, first + i, PROGRESS) for i in range(steps)]
        return 1e3 * fmean(times[steps // 2 :])  # by then the number of rays has found its level

    block(data, 0, WARMUP)
    for _, _, variant in everything:
        block(variant, 0, BLOCK)
    times = [[block(v, BLOCK * r, BLOCK) for _, _, v in everything] for r in range(ROUNDS)]
    first = {axis: i for i, (axis, _, _) in reversed(list(enumerate(everything)))}
    return [
        {
            "axis": axis,
            "value": value,
            "step_ms": median(row[i] for row in times),
            "ratio": median(row[i] / row[first[axis]] for row in times),
        }
        for i, (axis, value, _) in enumerate(everything)
    ]
