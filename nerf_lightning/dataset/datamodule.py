"""How data modules feed a system: a batch for each step, drawn from the seed, the step and what data were told of
earlier steps, which checkpoints keep, and held-out views whole."""

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
    """Makes a batch for each index.

    Args:
        make: index -> batch.
        indices: steps, each asked for when its batch is wanted, so that a resumed run goes on where it stopped; or views.
        length: how many; endless for steps. Without one, Lightning reads a batch ahead, which would break exact resuming.
    """

    def __init__(self, make: Callable[[int], Batch], indices: Iterable[int], length: int = ENDLESS_LENGTH):
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

    is_posed: ClassVar[bool]
    """Whether it draws from the posed photos of a scene, not from a picture."""
    scene: Any
    """The `Scene` or `Picture`."""
    num_held_out_views: int

    def __init__(self, photos: Photos, seed: int):
        super().__init__()
        self.photos: Photos = photos
        self.seed = seed
        self.test_subset = ALL_PIXELS
        """What `test_dataloader` gives of each held-out view."""
        self._device_photos: Photos | None = None
        """The photos, on the device where batches are drawn."""

    def draw(self, step: int) -> Any:
        """The batch of a step; of several processes that share a run, each gets every so many entries of it."""
        trainer = self.trainer
        if self._device_photos is None:
            device = CPU if trainer is None else trainer.strategy.root_device
            self._device_photos = self.photos.to(device if fits_in_memory(self.photos.nbytes, device) else CPU)
        part = slice(None) if trainer is None else slice(trainer.global_rank, None, trainer.world_size)
        return self.draw_batch(self._device_photos, step, part)

    def draw_batch(self, photos: Photos, step: int, part: slice) -> Any:
        """A part of the batch of a step."""
        raise TypeError(f"{type(self).__name__} must define draw_from(photos, step, part)")

    def reset(self) -> None:
        """Before another training on the same photos."""

    def find_issues(self, refines_poses: bool) -> list[SceneIssue]:
        """What to warn of before training, see `check_scene`."""
        return []

    def get_held_out_view(self, view: int, subset: PixelSubset = ALL_PIXELS) -> Any:
        """One held-out view."""
        raise TypeError(f"{type(self).__name__} must define held_out(view, subset)")

    def set_test_subset(self, subset: PixelSubset) -> None:
        """The next test loads only these pixels of each held-out view."""
        self.test_subset = subset

    def train_dataloader(self) -> BatchLoader:
        return BatchLoader(self.draw, iter(lambda: self.trainer.global_step if self.trainer else 0, None))

    def test_dataloader(self) -> BatchLoader:
        views = self.num_held_out_views
        return BatchLoader(lambda view: self.get_held_out_view(view, self.test_subset), range(views), views)

    def teardown(self, stage: str) -> None:
        self._device_photos = None  # the next trainer may use another device
