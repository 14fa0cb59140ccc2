"""Checkpoints: the last state, to resume from, and the best one by validation PSNR."""

import time
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import lightning as L
import torch
from lightning.fabric.plugins.io.torch_io import TorchCheckpointIO

from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.evaluation import Evaluation, compute_statistic
from nerf_lightning.callbacks.trainer_access import broadcast_from_rank_zero, find_callback
from nerf_lightning.callbacks.validation import PeriodicValidation
from nerf_lightning.system import System
from nerf_lightning.utils.files import atomic_write, link_file
from nerf_lightning.utils.option_checks import Ge
from nerf_lightning.utils.signals import SignalInterrupt, defer_signals, install_handlers, received_signal
from nerf_lightning.utils.text import subsample

CHECKPOINT_FOLDER = "checkpoints"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes checkpoints atomically, without Lightning's detour through memory and the system's temporary folder."""

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any | None = None) -> None:
        # Errors of Python's files report a full disk, unlike those of PyTorch's own writer.
        with atomic_write(Path(path)) as temporary, temporary.open("wb") as file:
            torch.save(checkpoint, file)


class Checkpoints(L.Callback):
    """Keeps `last.ckpt` and `best.ckpt`, each written atomically: a killed run keeps the previous one.

    On Ctrl-C or SIGTERM a run finishes its step, or the view that it measures, and saves `last.ckpt`: resuming from there gives
    the same weights.

    Args:
        every_seconds: wall-clock seconds between saves of `last.ckpt`; it is also saved at the end.
    """

    def __init__(self, every_seconds: Annotated[float, Ge(0)] = 20):
        self.every_seconds = every_seconds
        self._last_save_time = 0.0
        self._deferred_signals = ExitStack()  # signals are deferred from the first step to the last
        self._is_training = False

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        trainer.strategy.checkpoint_io = AtomicCheckpointIO()

    def save(self, trainer: L.Trainer, name: str) -> None:
        with Budget.find(trainer).pause():
            trainer.save_checkpoint(Path(trainer.default_root_dir) / CHECKPOINT_FOLDER / name)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self._last_save_time = time.monotonic()
        install_handlers()
        self._deferred_signals.enter_context(defer_signals())
        self._is_training = True

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        validation = find_callback(trainer, PeriodicValidation)
        curve = validation.curve if validation is not None else []
        best = bool(curve) and curve[-1] == max(curve, key=itemgetter(2)) and curve[-1][1] == trainer.global_step
        is_due = time.monotonic() - self._last_save_time >= self.every_seconds
        best, is_due, signum = broadcast_from_rank_zero(trainer, (best, is_due, received_signal()))
        if best:
            self.save(trainer, "best.ckpt")
        if signum is not None:
            raise SignalInterrupt(signum)
        if is_due:
            self.save(trainer, "last.ckpt")
            self._last_save_time = time.monotonic()

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.save(trainer, "last.ckpt")
        self._is_training = False
        self._deferred_signals.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        try:
            if isinstance(exception, SignalInterrupt) and self._is_training:
                self.save(trainer, "last.ckpt")
        finally:
            self._is_training = False
            self._deferred_signals.__exit__(type(exception), exception, exception.__traceback__)

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        """Lets the final state compete for `best.ckpt`, on the same views as the earlier ones."""
        validation, evaluation = find_callback(trainer, PeriodicValidation), find_callback(trainer, Evaluation)
        last = Path(trainer.default_root_dir) / CHECKPOINT_FOLDER / "last.ckpt"
        if evaluation is None or not trainer.is_global_zero or not last.exists():
            return
        earlier, views = ([], None) if validation is None else (validation.curve, validation.views)
        metrics = [evaluation.view_metrics[view] for view in subsample(len(evaluation.view_metrics), views)]
        final = compute_statistic(metrics, fmean, "psnr")
        if not earlier or (final is not None and final > max(point[2] for point in earlier)):
            link_file(last, last.with_name("best.ckpt"))  # for a large picture each takes 900 MB
