"""What a callback finds on its trainer. Lightning sets these at run time, so type checkers do not know them."""

from typing import TypeVar

import lightning as L

from nerf_lightning.dataset import DataModule

CallbackT = TypeVar("CallbackT", bound=L.Callback)
ValueT = TypeVar("ValueT")


def find_callback(trainer: L.Trainer, kind: type[CallbackT]) -> CallbackT | None:
    """The trainer's callback of a kind, or None."""
    return next((callback for callback in trainer.callbacks if isinstance(callback, kind)), None)  # type: ignore[attr-defined]


def get_datamodule(trainer: L.Trainer) -> DataModule:
    """The data module of the run."""
    return trainer.datamodule  # type: ignore[attr-defined]


def broadcast_from_rank_zero(trainer: L.Trainer, value: ValueT) -> ValueT:
    """The first process's value in all processes of a run: clocks differ, and all must decide the same."""
    return trainer.strategy.broadcast(value) if trainer.world_size > 1 else value
