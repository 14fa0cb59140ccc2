"""Checkpoints: the last state, to resume from, and the best one measured."""

import shutil
import time
from contextlib import ExitStack
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import lightning as L
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from nerf_lightning.callbacks.attached import agreed, attached
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.errors import NoRoom
from nerf_lightning.system import System
from nerf_lightning.utils.files import atomic, link_file
from nerf_lightning.utils.options import AtLeast
from nerf_lightning.utils.signals import Interrupted, defer_signals, install_handlers, received_signal
from nerf_lightning.utils.text import subsample

COPIES = 3
"""Of all parameters in a checkpoint: themselves and Adam's two means. Other optimisers keep less."""
NAMES = ("last.ckpt", "best.ckpt")


class InPlace(TorchCheckpointIO):
    """Writes directly to the path. Lightning writes into memory, then into the system's temporary folder, which may be full."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        with open(path, "wb") as file:  # whose errors say that a disk is full, unlike those of PyTorch's own writer
            torch.save(checkpoint, file)


def check_disk(folder: Path, system: System) -> None:
    """Asks, before a run begins, whether its checkpoints fit on the disk: the last, the best, and one that is being written.

    Args:
        folder: where they will be; those of a resumed run are replaced.
        system: to be trained.

    Raises:
        NoRoom: where they do not.
    """
    values = sum(p.numel() for p in system.parameters()) - system.field.values + system.field.values_grown()
    one = 4 * COPIES * values + sum(b.numel() * b.element_size() for b in system.buffers())
    there = sum(file.stat().st_size for file in map(folder.joinpath, NAMES) if file.is_file())
    needed = (len(NAMES) + 1) * one - there
    existing = next(place for place in (folder.absolute(), *folder.absolute().parents) if place.is_dir())
    free = shutil.disk_usage(existing).free
    if free < needed:
        expected = (
            f"{needed / 1e6:,.1f} MB for checkpoints (the last, the best, one being written: {one / 1e6:,.1f} MB each)"
        )
        raise NoRoom(folder, "", f"{free / 1e6:,.1f} MB free", expected, "make room, or callbacks.checkpoints=null")


class Checkpoints(L.Callback):
    """Keeps `last.ckpt` and `best.ckpt`. Each is written whole, then renamed: a killed run keeps the one before.

    A run that is asked to end (Ctrl-C, SIGTERM) finishes its step, or the view that it measures, and saves `last.ckpt`:
    going on from there gives the same weights.

    Args:
        every_seconds: wall-clock seconds between saves of `last.ckpt`; it is also saved at the end.
    """

    folder = "checkpoints"
    """Below the run folder."""

    def __init__(self, every_seconds: Annotated[float, AtLeast(0)] = 20):
        self.every_seconds = every_seconds
        self.best: float | None = None
        self._saved = 0.0
        self._judged = 0  # measurements compared so far
        self._tested: list[float] = []
        self._steps = ExitStack()  # signals are held back from the first step to the last
        self._stepping = False

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        trainer.strategy.checkpoint_io = InPlace()

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
        install_handlers()
        self._steps.enter_context(defer_signals())
        self._stepping = True

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        due, signum = agreed(trainer, (time.monotonic() - self._saved >= self.every_seconds, received_signal()))
        if signum is not None:
            raise Interrupted(signum)
        if due:
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
        self._stepping = False
        self._steps.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        try:
            if isinstance(exception, Interrupted) and self._stepping:
                self.save(trainer, "last.ckpt")
        finally:
            self._stepping = False
            self._steps.__exit__(type(exception), exception, exception.__traceback__)

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._tested = []

    def on_test_batch_end(self, trainer: L.Trainer, pl_module: System, outputs: Any, *batch: Any) -> None:
        self._tested.append(outputs["psnr"])

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        """The final state competes for `best.ckpt` too, on the same views as the earlier ones."""
        if not trainer.is_global_zero:
            return
        folder = Path(trainer.default_root_dir) / self.folder
        last = folder / "last.ckpt"
        held_out = attached(trainer, HeldOut)
        views = subsample(len(self._tested), held_out.views if held_out is not None else None)
        final = fmean(self._tested[view] for view in views)
        if last.exists() and (self.best is None or final > self.best):
            self.best = final
            link_file(last, folder / "best.ckpt")  # of a large picture's field each is 900 MB

    def state_dict(self) -> dict[str, Any]:
        return {"best": self.best}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.best = state_dict["best"]
