"""RayDataModule: rays and their pixels, drawn from all training photos."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset.focus import Focus
from nerf_lightning.dataset.loader import StepDataModule
from nerf_lightning.dataset.matching.judge import Doubt
from nerf_lightning.dataset.plausible import check_scene
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.subset import WHOLE, PixelSubset
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.options import AtLeast, AtMost, Count
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.tensors import TensorDataclass

RAYS, SAMPLES = 1024, 16384
"""Rays of the first step, and the samples per step that the number of rays then adapts to."""
Focused = Annotated[float, AtLeast(0), AtMost(0.99)]
FOCUS = 0.5
"""Share of the rays that are drawn by the error around them."""
SOME_PIXELS = 8192
"""Pixels drawn to measure the error of one plain colour."""
NEIGHBOUR = 0.0125
"""How far from a pixel its photo is looked at for `measure_texturelessness`, in longer sides of the photo."""
CONTRAST = 0.01
"""Difference of colours at which a photo is plain by 1/e: two or three steps of 8 bits, hardly more than their noise."""


@dataclass(frozen=True)
class RayBatch(TensorDataclass):
    """R rays and their pixels."""

    rays: Rays
    pixels: UInt8[Tensor, "R C"]
    """sRGB, with straight alpha where C is 4."""
    views: Int[Tensor, "R"] | None = field(default=None, kw_only=True)
    """The training photo that each belongs to; None where that is not asked for."""
    texturelessness: Float[Tensor, "R"] | None = field(default=None, kw_only=True)
    """Of the photo around each, see `measure_texturelessness`; None where that is not asked for."""
    weights: Float[Tensor, "R"] | None = field(default=None, kw_only=True)
    """How much each counts, see `Focus`; None where all count the same."""


@dataclass(frozen=True)
class ViewBatch(RayBatch):
    """Rays of one view, row by row; R = height * width."""

    height: int
    width: int
    known: Bool[Tensor, "R"] | None = None
    """Which pixels count; None for all."""
    strip: int | None = None
    """See `PixelSubset.strip`."""


def rays_through(views: Views, places: Int[Tensor, "R"]) -> tuple[Rays, Int[Tensor, "R"]]:
    """Rays through the pixels at these places in `Views.pixels`, and the photos they belong to."""
    places = places.contiguous()  # of several processes each has every so many
    view = torch.searchsorted(views.starts, places, right=True) - 1
    pixel, width = places - views.starts[view], views.widths[view]
    return views.cameras.rays(view, pixel // width, pixel % width), view


def view_batch(views: Views, view: int, subset: PixelSubset = WHOLE) -> ViewBatch:
    """One view, or some of its pixels."""
    rows, columns = subset.grid(*views.cameras.size(view))
    row, column = (x.flatten() for x in torch.meshgrid(rows, columns, indexing="ij"))
    rays = views.cameras.rays(torch.full_like(row, view), row, column)
    known = None if views.known is None else views.mask_of(view)[row, column]
    return ViewBatch(rays, views.image(view)[row, column], len(rows), len(columns), known, subset.strip)


def measure_texturelessness(views: Views, places: Int[Tensor, "R"], view: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
    """How textureless photos are around the pixels at these places in `Views.pixels`: 1 where the colour is the same on all
    four sides, falling toward 0 with its largest difference.

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


def make_batch(
    views: Views, places: Int[Tensor, "R"], with_texture: bool = False, weights: Float[Tensor, "R"] | None = None
) -> RayBatch:
    """Rays and pixels at these places in `Views.pixels`; `weights` and, if asked for, `texturelessness` as in `RayBatch`.

    Photos stay bytes, and rays are made only for these pixels: the cost does not depend on the number of photos.
    """
    rays, view = rays_through(views, places)
    textureless = measure_texturelessness(views, places, view) if with_texture else None
    return RayBatch(rays, views.pixels[places], views=view, texturelessness=textureless, weights=weights)


class RayDataModule(StepDataModule[Views]):
    """Feeds NeRF3D.

    Args:
        scene: the photos and cameras.
        rays: rays a step, which several processes share; with `samples`, only of the first.
        samples: aim for this many samples a step by adapting the number of rays; None keeps `rays`.
        seed: of the draw.
        focus: share of the rays that are drawn by the error of what is around them, see `Focus`; 0 draws all alike.
    """

    has_cameras = True
    MOST_RAYS = 32  # times the rays of the first step

    def __init__(
        self, scene: Scene, rays: Count = RAYS, samples: Count | None = SAMPLES, seed: int = 0, focus: Focused = FOCUS
    ):
        super().__init__(scene.train, seed)
        self.scene = scene
        self.rays = self.first_rays = rays
        self.samples = samples
        self.focus = focus
        self._focus: Focus | None = None
        self._focus_state: dict[str, Tensor] = {}
        """What `_focus` goes on from, when photos are drawn from for the first time."""
        self._with_texture = False
        self._resolution_scale = 1.0

    def enlarge(self, batch: int) -> None:
        """Takes that many times the rays and samples a step, for a device that takes more at once. Before training."""
        self.rays = self.first_rays = self.first_rays * batch
        self.samples = None if self.samples is None else self.samples * batch

    def measure_texture(self, is_asked: bool) -> None:
        """Sets whether batches say how textureless photos are."""
        self._with_texture = is_asked

    def set_resolution_scale(self, scale: float) -> None:
        """Sets the factor on the samples aimed for, see `Field.resolution_scale`: fewer meet in a small cell, and gradients
        would be noise."""
        self._resolution_scale = scale

    def note_samples(self, drawn: int) -> None:
        """Called with the samples that a step's rays took: moves the number of rays toward the aim."""
        if self.samples is None:
            return
        # Damped, since one batch's count is noisy; bounded, since empty space would ask for endless rays.
        wanted = self.rays * round(self.samples * self._resolution_scale) / max(drawn, 1)
        limit = self.first_rays * self.MOST_RAYS
        self.rays = max(min(64, limit), min(limit, round(0.7 * self.rays + 0.3 * min(wanted, limit))))

    def note_errors(self, errors: Float[Tensor, "R"], counted: Bool[Tensor, "R"] | None = None) -> None:
        """Called after each step with the squared errors of all its rays, those of other processes too, and which of them were
        measured: later steps look more where they are large."""
        if self._focus is not None:
            self._focus.note(errors, counted)

    def start_again(self) -> None:
        """Before another training on the same photos: nothing is known of errors, and a first step's number of rays."""
        self.rays = self.first_rays
        self._focus, self._focus_state = None, {}

    def draw_from(self, photos: Views, step: int, part: slice) -> RayBatch:
        generator = step_generator(self.seed, Stream.BATCH, step, photos.pixels.device)
        if self.focus == 0:
            return make_batch(photos, photos.draw(self.rays, generator)[part], self._with_texture)
        if self._focus is None or self._focus.views is not photos:
            self._focus_state = self._focus_state if self._focus is None else self._focus.state_dict()
            self._focus = Focus(photos, self.focus)
            if len(self._focus_state.get("sums", ())) == len(self._focus.sums):  # else of other photos, or of none
                self._focus.load_state_dict(self._focus_state)
        places, weights = self._focus.draw(self.rays, generator)
        return make_batch(photos, places[part], self._with_texture, weights[part])

    def some_pixels(self) -> RayBatch:
        """Training pixels to measure the error of one plain colour on."""
        generator = step_generator(self.seed, Stream.PLAIN, 0)
        return make_batch(self.scene.train, self.scene.train.draw(SOME_PIXELS, generator))

    def small_batch(self) -> RayBatch:
        """A few rays, to compile kernels with."""
        generator = step_generator(0, Stream.BATCH, 0)
        return make_batch(self.scene.train, self.scene.train.draw(64, generator), with_texture=True)

    def find_doubts(self, corrected: bool) -> list[Doubt]:
        return check_scene(self.scene, corrected)

    @property
    def held_out_views(self) -> int:
        return len(self.scene.val)

    def pixels_held_out(self, view: int) -> int:
        width, height = self.scene.val.cameras.size(view)
        return width * height

    def held_out(self, view: int, subset: PixelSubset = WHOLE) -> ViewBatch:
        return view_batch(self.scene.val, view, subset)

    def state_dict(self) -> dict[str, Any]:
        focus = self._focus_state if self._focus is None else self._focus.state_dict()
        return {"rays": self.rays, "focus": focus}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._focus, self._focus_state = None, dict(state_dict["focus"])
        if self.samples is not None:
            self.rays = min(self.first_rays * self.MOST_RAYS, state_dict["rays"])
