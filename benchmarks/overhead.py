"""What Lightning, callbacks and logging add to a step."""

import tempfile
import time
from pathlib import Path
from statistics import fmean, median, quantiles
from typing import Any

import lightning as L
import torch

from benchmarks.speed import build, take_step
from nerf_lightning.config.build import build_trainer, device_of
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.growth import follow_resolution

BLOCK = 32
"""Steps in a row of one kind: two rounds of the occupancy grid, short against a machine's moods."""
BLOCKS, FIRST = 50, 10
"""Blocks of each kind, and the first that counts."""


class Alternation(L.Callback):
    """After each block of the Trainer's steps, takes as many without it: same field, same optimiser, same photos.

    Of every block the last step is left out, because in the Trainer's it ends in this callback's own work.
    """

    def __init__(self, data: RayDataModule) -> None:
        self.data = data
        self.trainer_blocks: list[float] = []
        """Mean seconds of a step, one entry a block."""
        self.bare_blocks: list[float] = []
        self._starts: list[float] = []

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: NeRF3D, batch: Any, batch_idx: int) -> None:
        step = trainer.global_step
        if step and step % BLOCK == 0:
            self.trainer_blocks.append((self._starts[-1] - self._starts[0]) / (BLOCK - 1))
            optimizer = pl_module.optimizers(use_pl_optimizer=False)
            assert isinstance(optimizer, torch.optim.Optimizer)
            steps = range(step - BLOCK, step)
            times = [take_step(pl_module, self.data, optimizer, past, pl_module.state.progress) for past in steps]
            self.bare_blocks.append(fmean(times[:-1]))
            self._starts = []
        self._starts.append(time.perf_counter())


def measure_overhead(overrides: list[str]) -> dict[str, float]:
    """Milliseconds of a step, bare and under a Trainer with all callbacks and the logger, in alternating blocks of one run.

    Measurements and pictures, whose time is no training time, are moved out of the way; the share is the median over pairs of
    neighbouring blocks, with its quartiles.
    """
    steps = BLOCKS * BLOCK + 1
    settings = [*overrides, f"budget.steps={steps}", "callbacks.heldout.at=[]", "callbacks.snapshots.steps=[]"]
    cfg, data, system = build(settings)
    own = RayDataModule(
        data.scene, rays=data.rays, samples=data.samples, seed=cfg.seed
    )  # the Trainer has drawn its batch
    follow_resolution(system, own)
    with tempfile.TemporaryDirectory() as folder:
        trainer, alternation = build_trainer(cfg, Path(folder), device_of(cfg)), Alternation(own)
        trainer.callbacks.insert(0, alternation)  # type: ignore[attr-defined]
        trainer.fit(system, data)
    full, bare = alternation.trainer_blocks[FIRST:], alternation.bare_blocks[FIRST:]
    lower, middle, upper = quantiles([100 * (a / b - 1) for a, b in zip(full, bare, strict=True)])
    return {
        "bare_ms": 1e3 * median(bare),
        "trainer_ms": 1e3 * median(full),
        "overhead_percent": middle,
        "lower_quartile": lower,
        "upper_quartile": upper,
    }
