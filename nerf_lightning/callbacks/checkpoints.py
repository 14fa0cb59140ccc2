"""Checkpoints: the last state, to resume from, and the best one measured."""

import shutil
import time
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, attached
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.errors import InputError
from nerf_lightning.system import System
from nerf_lightning.utils.evenly import evenly
from nerf_lightning.utils.files import atomic


class Checkpoints(L.Callback):
    """Keeps `last.ckpt` and `best.ckpt` in a folder. Each is written whole, then renamed: a killed run keeps the one before.

    Args:
        folder: where they go, below the run folder.
        every_seconds: wall-clock seconds between saves of `last.ckpt`; it is also saved at the end.

    Raises:
        InputError: where every_seconds <= 0.
    """

    def __init__(self, folder: str = "checkpoints", every_seconds: float = 20):
        if every_seconds <= 0:
            raise InputError("callbacks.checkpoints.every_seconds", "", str(every_seconds), "more than 0")
        self.folder = folder
        self.every_seconds = every_seconds
        self.best: float | None = None
        self._saved = 0.0
        self._judged = 0  # measurements compared so far
        self._tested: list[float] = []

    def save(self, trainer: L.Trainer, name: str) -> None:
        path = Path(trainer.default_root_dir) / self.folder / name
        with Budget.of(trainer).paused():
            if not trainer.is_global_zero:
                trainer.save_checkpoint(path)  # writes nothing here, but the first process waits for the others
                return
            with atomic(path) as temporary:
                trainer.save_checkpoint(temporary)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._saved = time.monotonic()

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if agreed(trainer, time.monotonic() - self._saved >= self.every_seconds):
            self.save(trainer, "last.ckpt")
            self._saved = time.monotonic()
        held_out = attached(trainer, HeldOut)
        quality = held_out.latest if held_out is not None else None
        if held_out is None or quality is None or len(held_out.curve) == self._judged:
            return
        self._judged = len(held_out.curve)
        if agreed(trainer, self.best is None or quality > self.best):
            self.best = quality
            self.save(trainer, "best.ckpt")

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.save(trainer, "last.ckpt")

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._tested = []

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self._tested.append(outputs["psnr"])

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        """The final state competes for `best.ckpt` too, on the same views as the earlier ones."""
        if not trainer.is_global_zero:
            return
        folder = Path(trainer.default_root_dir) / self.folder
        last = folder / "last.ckpt"
        held_out = attached(trainer, HeldOut)
        views = evenly(len(self._tested), held_out.views if held_out is not None else None)
        final = fmean(self._tested[view] for view in views)
        if last.exists() and (self.best is None or final > self.best):
            self.best = final
            with atomic(folder / "best.ckpt") as temporary:
                shutil.copyfile(last, temporary)

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best = state_dict["best"]
