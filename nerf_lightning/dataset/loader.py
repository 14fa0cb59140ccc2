"""The training stream: one batch a step, drawn from nothing but the seed and the step's number."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import lightning as L
import torch

from nerf_lightning.utils.device import CPU, fits

Batch = TypeVar("Batch")

ENDLESS = 2**31 - 1
"""Reported length. Lightning reads one batch ahead of a loader without length, which would break exact resuming."""


def share(trainer: L.Trainer | None) -> slice:
    """Which entries of a step's draw are this process's, where several share a run: all together make the whole draw."""
    return slice(None) if trainer is None else slice(trainer.global_rank, None, trainer.world_size)


def drawn_on(trainer: L.Trainer | None, size: int) -> torch.device:
    """Where batches are drawn: on the device that trains, if it has room for so many bytes of photos."""
    device = CPU if trainer is None else trainer.strategy.root_device
    return device if fits(size, device) else CPU


class StepLoader:
    """Calls `draw(step)` for each step; `step()` tells which one is next, so a resumed run goes on where it stopped."""

    def __init__(self, draw: Callable[[int], Batch], step: Callable[[], int]):
        self.draw = draw
        self.step = step

    def __len__(self) -> int:
        return ENDLESS

    def __iter__(self) -> Iterator:
        while True:
            yield self.draw(self.step())

    def state_dict(self) -> dict[str, int]:
        """Nothing to keep: the trainer's step count says it all. Being there tells Lightning that resuming is exact."""
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Nothing to restore, see `state_dict`."""


class HeldOutLoader:
    """The held-out views in order, one whole view a batch."""

    def __init__(self, view: Callable[[int], Batch], views: int):
        self.view = view
        self.views = views

    def __len__(self) -> int:
        return self.views

    def __iter__(self) -> Iterator:
        return map(self.view, range(self.views))
