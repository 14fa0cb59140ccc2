"""How the time of a step grows: with samples a step, with the number of photos, with their size; and how threads share it."""

import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median

import torch

from benchmarks.bare import bare_step
from benchmarks.setup import built
from nerf_lightning.dataset import RayDataModule, Views
from nerf_lightning.dataset.resize import resize_views
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.machine import cores

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


def block_ms(system: NeRF3D, data: RayDataModule, optimizer: torch.optim.Optimizer, first: int, steps: int) -> float:
    """Milliseconds of a step, the mean over the later half of some: by then the number of rays has found its level."""
    times = [bare_step(system, data, optimizer, first + i, PROGRESS) for i in range(steps)]
    return 1e3 * fmean(times[steps // 2 :])


def measure(overrides: list[str]) -> list[dict[str, float | str]]:
    """Milliseconds of a step along each axis, all measured on one field in training, block after block in turn.

    `ratio` is that to the axis's first point, the median over rounds.
    """
    with tempfile.TemporaryDirectory() as folder:
        cfg, data, system = built(overrides, Path(folder))
    optimizer = system.configure_optimizers()
    everything = points(data, cfg.seed)
    block_ms(system, data, optimizer, 0, WARMUP)
    for _, _, variant in everything:
        block_ms(system, variant, optimizer, 0, BLOCK)
    times = [[block_ms(system, v, optimizer, BLOCK * r, BLOCK) for _, _, v in everything] for r in range(ROUNDS)]
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


def by_threads(experiments: list[str], overrides: list[str]) -> list[dict[str, float | str]]:
    """Milliseconds of a step of each experiment on 1, 2, 4, ... threads, as many as there are cores, measured in turn.

    `efficiency` is the share of those threads that one thread's time explains, the median over rounds.
    """
    counts = [2**power for power in range(cores().bit_length())]
    before, rows = torch.get_num_threads(), []
    for experiment in experiments:
        with tempfile.TemporaryDirectory() as folder:
            _, data, system = built([f"+experiment={experiment}", *overrides], Path(folder))
        optimizer = system.configure_optimizers()
        block_ms(system, data, optimizer, 0, WARMUP)
        times: list[list[float]] = []
        for turn in range(ROUNDS):
            times.append([])
            for count in counts:
                torch.set_num_threads(count)
                times[-1].append(block_ms(system, data, optimizer, WARMUP + BLOCK * turn, BLOCK))
        torch.set_num_threads(before)
        rows += [
            {
                "experiment": experiment,
                "threads": count,
                "step_ms": median(row[i] for row in times),
                "efficiency": median(row[0] / (count * row[i]) for row in times),
            }
            for i, count in enumerate(counts)
        ]
    return rows
