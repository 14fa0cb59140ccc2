"""RayDataModule: rays and their pixels, drawn evenly over all training photos."""

from dataclasses import dataclass

import lightning as L
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset.loader import HeldOutLoader, StepLoader, drawn_on, share
from nerf_lightning.dataset.scene import Scene, Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.seeding import step_generator


@dataclass(frozen=True)
class RayBatch:
    """R rays and what the photos show there."""

    rays: Rays
    pixels: UInt8[Tensor, "R C"]
    """sRGB, with straight alpha where C is 4."""

    def to(self, device: torch.device | str) -> "RayBatch":
        return RayBatch(self.rays.to(device), self.pixels.to(device))

    def target(self, backgrounds: Float[Tensor, "R 3"]) -> Float[Tensor, "R 3"]:
        """The pixels in [0, 1], composited onto `backgrounds` where they have alpha."""
        pixels = (self.pixels / 255).to(backgrounds.dtype)
        if pixels.shape[1] == 3:
            return pixels
        return torch.lerp(backgrounds, pixels[:, :3], pixels[:, 3:])


@dataclass(frozen=True)
class ViewBatch(RayBatch):
    """All rays of one view, row by row; R = height * width."""

    height: int
    width: int

    def to(self, device: torch.device | str) -> "ViewBatch":
        return ViewBatch(self.rays.to(device), self.pixels.to(device), self.height, self.width)


def draw_rays(views: Views, count: int, generator: torch.Generator, part: slice = slice(None)) -> RayBatch:  # noqa: B008
    """`count` pixels with replacement, each as likely as any other of all views, and of these a part.

    Photos stay as bytes and rays are made for the drawn pixels alone, so the cost does not depend on how many there are.
    """
    height, width = views.cameras.height, views.cameras.width
    whole = len(views) * height * width
    flat = torch.randint(whole, (count,), generator=generator, device=views.images.device)[part]
    view, pixel = flat // (height * width), flat % (height * width)
    row, col = pixel // width, pixel % width
    return RayBatch(views.cameras.rays(view, row, col), views.images[view, row, col])


class RayDataModule(L.LightningDataModule):
    """Feeds NeRF3D.

    Args:
        scene: the photos and cameras.
        rays: rays a step, which several processes share; with `samples`, only of the first.
        samples: aim for this many samples a step by adapting the number of rays; None keeps `rays`.
        seed: of the draw.

    Raises:
        InputError: for less than one ray or sample a step.
    """

    MOST_RAYS = 32  # times the rays of the first step

    def __init__(self, scene: Scene, rays: int = 4096, samples: int | None = None, seed: int = 0):
        super().__init__()
        if rays < 1:
            raise InputError("dataset.rays", "", str(rays), "at least 1")
        if samples is not None and samples < 1:
            raise InputError("dataset.samples", "", str(samples), "at least 1, or null for a fixed number of rays")
        self.scene = scene
        self.rays = self.first_rays = rays
        self.samples = samples
        self.seed = seed
        self.batch = 1
        self._near: Views | None = None
        """The photos where batches are drawn."""

    def enlarge(self, batch: int) -> None:
        """Takes so many times as many rays and samples a step, for a device that takes more at once. Before training."""
        self.batch *= batch
        self.rays = self.first_rays = self.first_rays * batch
        self.samples = None if self.samples is None else self.samples * batch

    def adapt(self, drawn: int) -> None:
        """Called after each step with the samples its rays took: moves the number of rays toward the aim."""
        if self.samples is None:
            return
        # Damped, since one batch's count is noisy; bounded, since empty space would ask for endless rays.
        wanted = self.rays * self.samples / max(drawn, 1)
        limit = self.first_rays * self.MOST_RAYS
        self.rays = max(min(64, limit), min(limit, round(0.7 * self.rays + 0.3 * min(wanted, limit))))

    def draw(self, step: int) -> RayBatch:
        if self._near is None:
            self._near = self.scene.train.to(drawn_on(self.trainer, self.scene.train.images.nbytes))
        device = self._near.images.device
        return draw_rays(self._near, self.rays, step_generator(self.seed, 0, step, device), share(self.trainer))

    def teardown(self, stage: str) -> None:
        self._near = None  # another trainer may have another device

    def train_dataloader(self) -> StepLoader:
        return StepLoader(self.draw, lambda: self.trainer.global_step if self.trainer else 0)

    @property
    def held_out_views(self) -> int:
        return len(self.scene.val)

    def held_out(self, view: int) -> ViewBatch:
        """One held-out view, whole."""
        views = self.scene.val
        height, width = views.cameras.height, views.cameras.width
        return ViewBatch(views.cameras.view_rays(view), views.images[view].flatten(0, 1), height, width)

    def test_dataloader(self) -> HeldOutLoader:
        return HeldOutLoader(self.held_out, self.held_out_views)

    def transfer_batch_to_device(self, batch: RayBatch, device: torch.device, dataloader_idx: int) -> RayBatch:
        return batch.to(device)

    def state_dict(self) -> dict[str, int]:
        return {"rays": self.rays, "batch": self.batch}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        before = state_dict.get("batch", 1)  # of another device, perhaps
        self.rays = max(1, state_dict["rays"] * self.batch // before)
