"""RayDataModule: rays and their pixels, drawn uniformly from all training photos."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset.loader import StepDataModule
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.seeding import Stream, step_generator

RAYS, SAMPLES = 1024, 16384
"""Rays of the first step, and the samples per step that the number of rays then adapts to."""
SOME_PIXELS = 8192
"""Pixels drawn to measure the error of one plain colour."""
NEIGHBOUR = 0.0125
"""How far from a pixel its photo is looked at for `plainness`, in longer sides of the photo."""
CONTRAST = 0.01
"""Difference of colours at which a photo is plain by 1/e: two or three steps of 8 bits, hardly more than their noise."""


@dataclass(frozen=True)
class RayBatch:
    """R rays and their pixels."""

    rays: Rays
    pixels: UInt8[Tensor, "R C"]
    """sRGB, with straight alpha where C is 4."""
    views: Int[Tensor, "R"] | None = field(default=None, kw_only=True)
    """The training photo that each belongs to; None where that is not asked for."""
    plain: Float[Tensor, "R"] | None = field(default=None, kw_only=True)
    """How plain the photo is around each, see `plainness`; None where that is not asked for."""

    def to(self, device: torch.device | str) -> "RayBatch":
        views, plain = (None if x is None else x.to(device) for x in (self.views, self.plain))
        return RayBatch(self.rays.to(device), self.pixels.to(device), views=views, plain=plain)


@dataclass(frozen=True)
class ViewBatch(RayBatch):
    """All rays of one view, row by row; R = height * width."""

    height: int
    width: int
    known: Bool[Tensor, "R"] | None = None
    """Which pixels count; None for all."""

    def to(self, device: torch.device | str) -> "ViewBatch":
        known = None if self.known is None else self.known.to(device)
        return ViewBatch(self.rays.to(device), self.pixels.to(device), self.height, self.width, known)


def rays_through(views: Views, places: Int[Tensor, "R"]) -> tuple[Rays, Int[Tensor, "R"]]:
    """Rays through the pixels at these places in `Views.pixels`, and the photos they belong to."""
    view = torch.searchsorted(views.starts, places, right=True) - 1
    pixel, width = places - views.starts[view], views.widths[view]
    return views.cameras.rays(view, pixel // width, pixel % width), view


def plainness(views: Views, places: Int[Tensor, "R"], view: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
    """How plain photos are around the pixels at these places in `Views.pixels`: 1 where the colour is the same on all four
    sides, falling toward 0 with its largest difference.

    Such places look alike in photos from elsewhere too, so that these hardly tell how far they are.
    """
    start, width = views.starts[view], views.widths[view]
    pixel, height = places - start, (views.starts[view + 1] - start) // width
    row, column = pixel // width, pixel % width
    reach = (NEIGHBOUR * torch.maximum(width, height)).round().long().clamp_min(1)
    sides = (
        start + row * width + (column - reach).clamp_min(0),
        start + row * width + torch.minimum(column + reach, width - 1),
        start + (row - reach).clamp_min(0) * width + column,
        start + torch.minimum(row + reach, height - 1) * width + column,
    )
    here = views.pixels[places].short()
    contrast = torch.stack([(views.pixels[side].short() - here).abs().amax(1) for side in sides]).amax(0)
    return torch.exp(-contrast / (255 * CONTRAST))


def draw_rays(
    views: Views,
    count: int,
    generator: torch.Generator,
    part: slice = slice(None),  # noqa: B008
    plain: bool = False,
) -> RayBatch:
    """Draws `count` pixels uniformly from all views, masked ones excepted, with replacement; returns a part of them.

    Photos stay bytes, and rays are made only for the drawn pixels: the cost does not depend on the number of photos.

    Args:
        views: the photos.
        count: pixels drawn.
        generator: of the draw.
        part: of the pixels that is returned.
        plain: whether to look how plain photos are around them.
    """
    whole = len(views.pixels) if views.known is None else len(views.known)
    flat = torch.randint(whole, (count,), generator=generator, device=views.pixels.device)[part]
    if views.known is not None:
        flat = views.known.find(flat)
    rays, view = rays_through(views, flat)
    return RayBatch(rays, views.pixels[flat], views=view, plain=plainness(views, flat, view) if plain else None)


class RayDataModule(StepDataModule[Views]):
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

    def __init__(self, scene: Scene, rays: int = RAYS, samples: int | None = SAMPLES, seed: int = 0):
        super().__init__(seed)
        if rays < 1:
            raise InputError("dataset.rays", "", str(rays), "at least 1")
        if samples is not None and samples < 1:
            raise InputError("dataset.samples", "", str(samples), "at least 1, or null for a fixed number of rays")
        self.scene = scene
        self.rays = self.first_rays = rays
        self.samples = samples
        self.batch = 1
        self.plain = False
        """Whether batches say how plain photos are, see `RayBatch.plain`."""
        self.finer = 1.0
        """Factor on the samples aimed for, see `Field.finer`: fewer meet in a small cell, and gradients would be noise."""

    @property
    def photos(self) -> Views:
        return self.scene.train

    def enlarge(self, batch: int) -> None:
        """Takes that many times the rays and samples a step, for a device that takes more at once. Before training."""
        self.batch *= batch
        self.rays = self.first_rays = self.first_rays * batch
        self.samples = None if self.samples is None else self.samples * batch

    def note_samples(self, drawn: int) -> None:
        """Called with the samples that a step's rays took: moves the number of rays toward the aim."""
        if self.samples is None:
            return
        # Damped, since one batch's count is noisy; bounded, since empty space would ask for endless rays.
        wanted = self.rays * round(self.samples * self.finer) / max(drawn, 1)
        limit = self.first_rays * self.MOST_RAYS
        self.rays = max(min(64, limit), min(limit, round(0.7 * self.rays + 0.3 * min(wanted, limit))))

    def start_again(self) -> None:
        """Before another training on the same photos: back to the number of rays of a first step."""
        self.rays = self.first_rays

    def draw_from(self, photos: Views, step: int, part: slice) -> RayBatch:
        generator = step_generator(self.seed, Stream.BATCH, step, photos.pixels.device)
        return draw_rays(photos, self.rays, generator, part, self.plain)

    def some_pixels(self) -> RayBatch:
        """Training pixels to measure the error of one plain colour on."""
        return draw_rays(self.scene.train, SOME_PIXELS, step_generator(self.seed, Stream.PLAIN, 0))

    @property
    def held_out_views(self) -> int:
        return len(self.scene.val)

    def held_out(self, view: int) -> ViewBatch:
        views = self.scene.val
        width, height = views.cameras.size(view)
        known = None if views.known is None else views.mask_of(view).flatten()
        return ViewBatch(views.cameras.view_rays(view), views.image(view).flatten(0, 1), height, width, known)

    def state_dict(self) -> dict[str, int]:
        return {"rays": self.rays, "batch": self.batch}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        before = state_dict.get("batch", 1)  # perhaps of another device
        self.rays = max(1, state_dict["rays"] * self.batch // before)
