"""Typed access to a trainer's callbacks and data module, which Lightning sets at run time."""

from typing import TypeVar

import lightning as L

from nerf_lightning.dataset import DataModule

CallbackT = TypeVar("CallbackT", bound=L.Callback)
ValueT = TypeVar("ValueT")


def find_callback(trainer: L.Trainer, kind: type[CallbackT]) -> CallbackT | None:
    """Finds the trainer's callback of a class; None without one."""
    return next((callback for callback in trainer.callbacks if isinstance(callback, kind)), None)  # type: ignore[attr-defined]


def get_datamodule(trainer: L.Trainer) -> DataModule:
    return trainer.datamodule  # type: ignore[attr-defined]


def broadcast_from_rank_zero(trainer: L.Trainer, value: ValueT) -> ValueT:
    """The first process's value in all processes of a run: clocks differ, and all must decide alike."""
    return trainer.strategy.broadcast(value) if trainer.world_size > 1 else value
