"""What Lightning, callbacks and logging add to a step."""

import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import lightning as L

from benchmarks.bare import bare_loop
from benchmarks.setup import built
from nerf_lightning.build import build_trainer

STEPS, FROM = 400, 200
"""Steps of a loop, and the first that counts."""


class Stopwatch(L.Callback):
    """Notes when each step starts."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_start(
        self, trainer: L.Trainer, pl_module: L.LightningModule, batch: Any, batch_idx: int
    ) -> None:
        self.times.append(time.perf_counter())


def measure(overrides: list[str], rounds: int = 5) -> dict[str, float]:
    """Milliseconds of a step, bare and under a Trainer with all callbacks and the logger: medians of alternating loops.

    Measurements and pictures, whose time is no training time, are moved out of the way; the share is the median over the pairs.
    """
    bare, full = [], []
    settings = [*overrides, f"budget.steps={STEPS}", "callbacks.heldout.at=[]", "callbacks.snapshots.steps=[]"]
    for _ in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            _, data, system = built(settings, Path(folder))
            bare.append(median(bare_loop(system, data, STEPS)[FROM:]))
            cfg, data, system = built(settings, Path(folder))
            trainer, watch = build_trainer(cfg, Path(folder)), Stopwatch()
            trainer.callbacks.insert(0, watch)  # type: ignore[attr-defined]
            trainer.fit(system, data)
            times = watch.times[FROM:]
            full.append(median(b - a for a, b in zip(times, times[1:], strict=False)))
    shares = [trainer / loop - 1 for trainer, loop in zip(full, bare, strict=True)]
    return {
        "bare_ms": 1e3 * median(bare),
        "trainer_ms": 1e3 * median(full),
        "overhead_percent": 100 * median(shares),
        "lowest_percent": 100 * min(shares),
        "highest_percent": 100 * max(shares),
    }
