"""How data modules feed a system: a batch for each step, drawn from the seed, the step and what data were told of
earlier steps, which checkpoints keep, and held-out views whole."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar, Generic, TypeVar

import lightning as L
from torch import Tensor

from nerf_lightning.dataset.matching.judge import Doubt
from nerf_lightning.dataset.subset import WHOLE, PixelSubset
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.memory import fits

Batch = TypeVar("Batch")
Photos = TypeVar("Photos", Views, Tensor)

ENDLESS = 2**31 - 1


class BatchLoader(Generic[Batch]):
    """Makes a batch for each index.

    Args:
        make: index -> batch.
        indices: steps, each asked for when its batch is wanted, so that a resumed run goes on where it stopped; or views.
        length: how many; endless for steps. Without one, Lightning reads a batch ahead, which would break exact resuming.
    """

    def __init__(self, make: Callable[[int], Batch], indices: Iterable[int], length: int = ENDLESS):
        self.make, self.indices, self.length = make, indices, length

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Batch]:
        return map(self.make, self.indices)

    def state_dict(self) -> dict[str, int]:
        """Nothing to keep but the trainer's step. Having the method tells Lightning that resuming is exact."""
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Nothing to restore, see `state_dict`."""


class StepDataModule(L.LightningDataModule, Generic[Photos]):
    """Base of the two data modules.

    Args:
        photos: what batches are drawn from.
        seed: of the draw.
    """

    has_cameras: ClassVar[bool]
    """Whether it draws from the posed photos of a scene, not from a picture."""
    scene: Any
    """The `Scene` or `Picture`."""
    held_out_views: int

    def __init__(self, photos: Photos, seed: int):
        super().__init__()
        self.photos: Photos = photos
        self.seed = seed
        self.tested = WHOLE
        """What `test_dataloader` gives of each held-out view."""
        self._near: Photos | None = None
        """The photos, on the device where batches are drawn."""

    def draw(self, step: int) -> Any:
        """The batch of a step; of several processes that share a run, each gets every so many entries of it."""
        trainer = self.trainer
        if self._near is None:
            device = CPU if trainer is None else trainer.strategy.root_device
            self._near = self.photos.to(device if fits(self.photos.nbytes, device) else CPU)
        part = slice(None) if trainer is None else slice(trainer.global_rank, None, trainer.world_size)
        return self.draw_from(self._near, step, part)

    def draw_from(self, photos: Photos, step: int, part: slice) -> Any:
        """A part of the batch of a step."""
        raise TypeError(f"{type(self).__name__} must define draw_from(photos, step, part)")

    def start_again(self) -> None:
        """Before another training on the same photos."""

    def find_doubts(self, corrected: bool) -> list[Doubt]:
        """What to warn of before training, see `check_scene`."""
        return []

    def held_out(self, view: int, subset: PixelSubset = WHOLE) -> Any:
        """One held-out view."""
        raise TypeError(f"{type(self).__name__} must define held_out(view, subset)")

    def test_on(self, subset: PixelSubset) -> None:
        """The next test loads only these pixels of each held-out view."""
        self.tested = subset

    def train_dataloader(self) -> BatchLoader:
        return BatchLoader(self.draw, iter(lambda: self.trainer.global_step if self.trainer else 0, None))

    def test_dataloader(self) -> BatchLoader:
        views = self.held_out_views
        return BatchLoader(lambda view: self.held_out(view, self.tested), range(views), views)

    def teardown(self, stage: str) -> None:
        self._near = None  # the next trainer may use another device
