"""Checkpoints: the last state, to resume from, and the best one measured."""

import time
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import lightning as L
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from nerf_lightning.callbacks.attached import agreed, attached
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.evaluation import Evaluation, statistic_of
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.system import System
from nerf_lightning.utils.files import atomic, link_file
from nerf_lightning.utils.options import AtLeast
from nerf_lightning.utils.signals import Interrupted, defer_signals, install_handlers, received_signal
from nerf_lightning.utils.text import subsample

FOLDER = "checkpoints"
"""Below the run folder."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a file beside the path, then renames it. Lightning writes into memory and the system's temporary folder."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        # Errors of Python's files say that a disk is full, unlike those of PyTorch's own writer.
        with atomic(Path(path)) as temporary, temporary.open("wb") as file:
            torch.save(checkpoint, file)


class Checkpoints(L.Callback):
    """Keeps `last.ckpt` and `best.ckpt`. Each is written whole, then renamed: a killed run keeps the one before.

    A run that is asked to end (Ctrl-C, SIGTERM) finishes its step, or the view that it measures, and saves `last.ckpt`:
    going on from there gives the same weights.

    Args:
        every_seconds: wall-clock seconds between saves of `last.ckpt`; it is also saved at the end.
    """

    def __init__(self, every_seconds: Annotated[float, AtLeast(0)] = 20):
        self.every_seconds = every_seconds
        self._saved = 0.0
        self._steps = ExitStack()  # signals are deferred from the first step to the last
        self._stepping = False

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        trainer.strategy.checkpoint_io = AtomicCheckpointIO()

    def save(self, trainer: L.Trainer, name: str) -> None:
        with Budget.of(trainer).paused():
            trainer.save_checkpoint(Path(trainer.default_root_dir) / FOLDER / name)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._saved = time.monotonic()
        install_handlers()
        self._steps.enter_context(defer_signals())
        self._stepping = True

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        held_out = attached(trainer, HeldOut)
        curve = held_out.curve if held_out is not None else []
        best = bool(curve) and curve[-1] == max(curve, key=itemgetter(2)) and curve[-1][1] == trainer.global_step
        due = time.monotonic() - self._saved >= self.every_seconds
        best, due, signum = agreed(trainer, (best, due, received_signal()))
        if best:
            self.save(trainer, "best.ckpt")
        if signum is not None:
            raise Interrupted(signum)
        if due:
            self.save(trainer, "last.ckpt")
            self._saved = time.monotonic()

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

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        """The final state competes for `best.ckpt` too, on the same views as the earlier ones."""
        held_out, measured = attached(trainer, HeldOut), attached(trainer, Evaluation)
        last = Path(trainer.default_root_dir) / FOLDER / "last.ckpt"
        if measured is None or not trainer.is_global_zero or not last.exists():
            return
        earlier, views = ([], None) if held_out is None else (held_out.curve, held_out.views)
        same = [measured.views[view] for view in subsample(len(measured.views), views)]
        final = statistic_of(same, fmean, "psnr")
        if not earlier or (final is not None and final > max(point[2] for point in earlier)):
            link_file(last, last.with_name("best.ckpt"))  # of a large picture's field each is 900 MB
