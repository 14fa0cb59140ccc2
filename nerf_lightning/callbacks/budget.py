"""Budget: how long to train, by the steps or by the clock, and the clock itself."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, attached
from nerf_lightning.errors import InputError
from nerf_lightning.machine import Load
from nerf_lightning.system import System


class Budget(L.Callback):
    """Stops training when the budget is spent and tells the system its progress.

    Training time is the wall clock from the first step on, less what runs inside `paused()` (evaluation, pictures). With
    both limits, the first one reached ends the run.

    Args:
        steps: optimiser steps, or None.
        seconds: seconds of training, or None.

    Raises:
        InputError: where both are None, or one is not positive.
    """

    def __init__(self, steps: int | None = None, seconds: float | None = None):
        if steps is None and seconds is None:
            raise InputError("budget", "", "neither steps nor seconds", "budget.steps=N or budget.seconds=S")
        for key, value in (("steps", steps), ("seconds", seconds)):
            if value is not None and value <= 0:
                raise InputError(f"budget.{key}", "", str(value), "more than 0")
        self.steps = steps
        self.limit_seconds = seconds
        self._before = 0.0  # spent up to the last pause or restart
        self._since: float | None = None
        self.load = Load()
        """What this process and others did while the clock ran."""

    @staticmethod
    def of(trainer: L.Trainer) -> "Budget":
        """The trainer's budget."""
        budget = attached(trainer, Budget)
        if budget is None:
            raise RuntimeError("a trainer needs a Budget among its callbacks; build_trainer puts one there")
        return budget

    @property
    def seconds(self) -> float:
        """Seconds trained so far."""
        return self._before + (0.0 if self._since is None else time.perf_counter() - self._since)

    def progress(self, step: int) -> float:
        """Fraction of the budget done after `step` steps, in [0, 1]."""
        done = [step / self.steps] if self.steps is not None else []
        if self.limit_seconds is not None:
            done.append(self.seconds / self.limit_seconds)
        return min(1.0, max(done))

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Stops the clock for work that is not training."""
        running = self._since is not None
        self._stop()
        try:
            yield
        finally:
            if running:
                self._start()

    def _start(self) -> None:
        self.load.start()
        self._since = time.perf_counter()

    def _stop(self) -> None:
        self._before, self._since = self.seconds, None
        self.load.stop()

    def shared_progress(self, trainer: L.Trainer) -> float:
        """`progress`, the same in all processes of a run."""
        progress = self.progress(trainer.global_step)
        return progress if self.limit_seconds is None else agreed(trainer, progress)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        trainer.should_stop = self.shared_progress(trainer) >= 1.0  # a finished run resumed has nothing left
        self._start()

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        pl_module.progress = self.shared_progress(trainer)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        pl_module.progress = self.shared_progress(trainer)
        if pl_module.progress >= 1.0:
            trainer.should_stop = True

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self._stop()

    def state_dict(self) -> dict[str, float]:
        return {"seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, float]) -> None:
        self._before = state_dict["seconds"]
