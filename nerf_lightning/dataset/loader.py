"""How data modules feed a system: a batch for each step, drawn from the seed, the step and what data were told of
earlier steps, which checkpoints keep, and held-out views whole."""

from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import lightning as L
import torch
from torch import Tensor

from nerf_lightning.dataset.subset import WHOLE, PixelSubset
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.device import CPU, fits

Batch = TypeVar("Batch")


Photos = TypeVar("Photos", Views, Tensor)

ENDLESS = 2**31 - 1
"""Reported length. Without one, Lightning reads a batch ahead, which would break exact resuming."""


def share(trainer: L.Trainer | None) -> slice:
    """This process's entries of a step's draw, if several processes share a run."""
    return slice(None) if trainer is None else slice(trainer.global_rank, None, trainer.world_size)


def drawn_on(trainer: L.Trainer | None, size: int) -> torch.device:
    """Where batches are drawn: on the training device, if it has room for `size` bytes of photos."""
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
        """Nothing to keep but the trainer's step. Having the method tells Lightning that resuming is exact."""
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Nothing to restore, see `state_dict`."""


class HeldOutLoader:
    """The held-out views in order, one a batch."""

    def __init__(self, view: Callable[[int], Batch], views: int):
        self.view = view
        self.views = views

    def __len__(self) -> int:
        return self.views

    def __iter__(self) -> Iterator:
        return map(self.view, range(self.views))


class StepDataModule(L.LightningDataModule, Generic[Photos]):
    """Base of the two data modules.

    Args:
        seed: of the draw.
    """

    held_out_views: int

    def __init__(self, seed: int):
        super().__init__()
        self.seed = seed
        self.tested = WHOLE
        """What `test_dataloader` gives of each held-out view."""
        self._near: Photos | None = None
        """The photos, on the device where batches are drawn."""

    @property
    def photos(self) -> Photos:
        """What batches are drawn from."""
        raise TypeError(f"{type(self).__name__} must define photos")

    def draw(self, step: int) -> Any:
        """The batch of a step: this process's share of it."""
        if self._near is None:
            self._near = self.photos.to(drawn_on(self.trainer, self.photos.nbytes))
        return self.draw_from(self._near, step, share(self.trainer))

    def draw_from(self, photos: Photos, step: int, part: slice) -> Any:
        """A part of the batch of a step."""
        raise TypeError(f"{type(self).__name__} must define draw_from(photos, step, part)")

    def held_out(self, view: int, subset: PixelSubset = WHOLE) -> Any:
        """One held-out view."""
        raise TypeError(f"{type(self).__name__} must define held_out(view, subset)")

    def pixels_held_out(self, view: int) -> int:
        """Of one held-out view."""
        raise TypeError(f"{type(self).__name__} must define pixels_held_out(view)")

    def test_on(self, subset: PixelSubset) -> None:
        """The next test loads only these pixels of each held-out view."""
        self.tested = subset

    def train_dataloader(self) -> StepLoader:
        return StepLoader(self.draw, lambda: self.trainer.global_step if self.trainer else 0)

    def test_dataloader(self) -> HeldOutLoader:
        return HeldOutLoader(lambda view: self.held_out(view, self.tested), self.held_out_views)

    def teardown(self, stage: str) -> None:
        self._near = None  # the next trainer may use another device
