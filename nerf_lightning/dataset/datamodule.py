"""Deterministic, step-indexed data loading: a batch depends only on seed, step and error map; validation is by view."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, ClassVar, Generic, TypeVar

import lightning as L
from torch import Tensor

from nerf_lightning.dataset.matching.pose_checks import SceneIssue
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.memory import fits_in_memory

Batch = TypeVar("Batch")
Photos = TypeVar("Photos", Views, Tensor)

ENDLESS_LENGTH = 2**31 - 1


class BatchLoader(Generic[Batch]):
    """Yields a batch for each index.

    Args:
        make: index -> batch.
        indices: steps, read lazily, so that a resumed run continues exactly; or views.
        length: number of batches; endless for steps. Without it Lightning prefetches a batch: resuming is not exact.
    """

    def __init__(self, make: Callable[[int], Batch], indices: Iterable[int], length: int = ENDLESS_LENGTH):
        self.make, self.indices, self.length = make, indices, length

    def __len__(self) -> int:
        return self.length

    def __iter__(self) -> Iterator[Batch]:
        return map(self.make, self.indices)

    def state_dict(self) -> dict[str, int]:
        """Empty: the trainer keeps the step. Defining the method tells Lightning that resuming is exact."""
        return {}

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Does nothing, see `state_dict`."""


class StepDataModule(L.LightningDataModule, Generic[Photos]):
    """Base class of the two data modules.

    Args:
        photos: pixels that batches are sampled from.
        seed: random seed of the sampling.
    """

    is_posed: ClassVar[bool]
    """True for posed photos of a scene, False for a picture."""
    scene: Any
    """The `Scene` or `Picture`."""
    num_held_out_views: int

    def __init__(self, photos: Photos, seed: int):
        super().__init__()
        self.photos: Photos = photos
        self.seed = seed
        self.test_subset = ALL_PIXELS
        """Pixels of each held-out view that `test_dataloader` yields."""
        self._device_photos: Photos | None = None
        """Copy on the device where batches are sampled."""

    def draw(self, step: int) -> Any:
        """Samples the batch of a step; in a distributed run each rank takes every `world_size`-th entry."""
        trainer = self.trainer
        if self._device_photos is None:
            device = CPU if trainer is None else trainer.strategy.root_device
            self._device_photos = self.photos.to(device if fits_in_memory(self.photos.nbytes, device) else CPU)
        part = slice(None) if trainer is None else slice(trainer.global_rank, None, trainer.world_size)
        return self.draw_batch(self._device_photos, step, part)

    def draw_batch(self, photos: Photos, step: int, part: slice) -> Any:
        """Samples a part of the batch of a step."""
        raise TypeError(f"{type(self).__name__} must define draw_batch(photos, step, part)")

    def reset(self) -> None:
        """Resets the state before another training on the same photos."""

    def find_issues(self, refines_poses: bool) -> list[SceneIssue]:
        """Problems to warn about before training, see `check_scene`."""
        return []

    def get_held_out_view(self, view: int, subset: PixelSubset = ALL_PIXELS) -> Any:
        """Loads one held-out view."""
        raise TypeError(f"{type(self).__name__} must define get_held_out_view(view, subset)")

    def set_test_subset(self, subset: PixelSubset) -> None:
        """Restricts the next test to these pixels of each held-out view."""
        self.test_subset = subset

    def train_dataloader(self) -> BatchLoader:
        return BatchLoader(self.draw, iter(lambda: self.trainer.global_step if self.trainer else 0, None))

    def test_dataloader(self) -> BatchLoader:
        views = self.num_held_out_views
        return BatchLoader(lambda view: self.get_held_out_view(view, self.test_subset), range(views), views)

    def teardown(self, stage: str) -> None:
        self._device_photos = None  # the next trainer may use another device
