"""RayDataModule: rays and pixels sampled from all training photos."""

from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset.datamodule import StepDataModule
from nerf_lightning.dataset.error_sampling import ErrorSampler
from nerf_lightning.dataset.matching.pose_checks import SceneIssue
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_checks import check_scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.option_checks import Count, Ge, Le
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.utils.tensor_dataclass import TensorDataclass

DEFAULT_RAYS, DEFAULT_SAMPLES = 1024, 16384
"""Rays in the first step, and target samples per step to which the number of rays adapts."""
ErrorSampling = Annotated[float, Ge(0), Le(0.99)]
DEFAULT_ERROR_SAMPLING = 0.5
"""Fraction of the rays sampled by error."""
STEPS_PER_DRAW = 16
"""Steps whose rays are sampled together, and between adaptations of their number, where photos lie on an accelerator: each
operation is a launch there."""
RAY_DAMPING = 0.7
"""Fraction of the last number of rays in the next: one batch's count is noisy."""
BASELINE_PIXELS = 8192
"""Pixels on which the constant-color baseline is measured."""
TEXTURE_RADIUS = 0.0125
"""Distance of the neighbors in `measure_texturelessness`, relative to the photo's longest side."""
TEXTURE_CONTRAST = 0.01
"""Contrast at which texturelessness is 1/e: two or three 8-bit levels, about the noise."""


@dataclass(frozen=True)
class RayBatch(TensorDataclass):
    """R rays and their pixels."""

    rays: Rays
    pixels: UInt8[Tensor, "R C"]
    """sRGB, with straight alpha where C is 4."""
    views: Int[Tensor, "R"] | None = field(default=None, kw_only=True)
    """Training photo of each ray; None if not requested."""
    texturelessness: Float[Tensor, "R"] | None = field(default=None, kw_only=True)
    """See `measure_texturelessness`; None if not requested."""
    weights: Float[Tensor, "R"] | None = field(default=None, kw_only=True)
    """Importance weights, see `ErrorSampler`; None for uniform sampling."""


@dataclass(frozen=True)
class ViewBatch(RayBatch):
    """Rays of one view, row-major; R = height * width."""

    height: int
    width: int
    valid_mask: Bool[Tensor, "R"] | None = None
    """Unmasked pixels; None for all."""
    strip: int | None = None
    """See `PixelSubset.strip`."""


def cast_rays(views: Views, pixels: Int[Tensor, "R"]) -> tuple[Rays, Int[Tensor, "R"]]:
    """Generates the rays through pixels, given as indices into `Views.pixels`, and returns their photos."""
    pixels = pixels.contiguous()  # each rank has a strided slice
    view = torch.searchsorted(views.offsets, pixels, right=True) - 1
    pixel, width = pixels - views.offsets[view], views.widths[view]
    return views.cameras.generate_rays(view, pixel // width, pixel % width), view


def make_view_batch(views: Views, view: int, subset: PixelSubset = ALL_PIXELS) -> ViewBatch:
    """Builds a batch of one view, or of a subset of its pixels."""
    rows, columns = subset.grid(*views.cameras.size(view))
    row, column = (x.flatten() for x in torch.meshgrid(rows, columns, indexing="ij"))
    rays = views.cameras.generate_rays(row.new_full((1,), view), row, column)
    valid = None if views.valid_mask is None else views.view_mask(view)[row, column]
    return ViewBatch(rays, views.image(view)[row, column], len(rows), len(columns), valid, subset.strip)


def measure_texturelessness(views: Views, pixels: Int[Tensor, "R"], view: Int[Tensor, "R"]) -> Float[Tensor, "R"]:
    """Texturelessness in [0, 1] around each pixel: 1 if its four neighbors have the same color, else exp(-contrast).

    Photos barely constrain the depth of textureless surfaces.
    """
    start, width = views.offsets[view], views.widths[view]
    pixel, height = pixels - start, (views.offsets[view + 1] - start) // width
    row, column = pixel // width, pixel % width
    offset = (TEXTURE_RADIUS * torch.maximum(width, height)).round().long().clamp_min(1)
    sides = (
        start + row * width + (column - offset).clamp_min(0),
        start + row * width + torch.minimum(column + offset, width - 1),
        start + (row - offset).clamp_min(0) * width + column,
        start + torch.minimum(row + offset, height - 1) * width + column,
    )
    here = views.pixels[pixels].short()
    contrast = torch.stack([(views.pixels[side].short() - here).abs().amax(1) for side in sides]).amax(0)
    return torch.exp(-contrast / (255 * TEXTURE_CONTRAST))


def make_batch(
    views: Views, pixels: Int[Tensor, "R"], with_texture: bool = False, weights: Float[Tensor, "R"] | None = None
) -> RayBatch:
    """Builds a batch of the given indices into `Views.pixels`.

    Photos stay uint8 and rays are generated for these pixels only: the cost does not depend on the number of photos.
    """
    rays, view = cast_rays(views, pixels)
    textureless = measure_texturelessness(views, pixels, view) if with_texture else None
    return RayBatch(rays, views.pixels[pixels], views=view, texturelessness=textureless, weights=weights)


class RayDataModule(StepDataModule[Views]):
    """Ray batches for NeRF3D.

    Args:
        scene: photos and cameras.
        rays: rays per step over all processes; with `samples`, in the first step.
        samples: target samples per step, by adapting the number of rays; None keeps `rays`.
        seed: random seed of the sampling.
        error_sampling: fraction of the rays sampled by error, see `ErrorSampler`; 0 samples uniformly.
    """

    is_posed = True
    MAX_RAYS_FACTOR = 32  # times the rays of the first step

    def __init__(
        self,
        scene: Scene,
        rays: Count = DEFAULT_RAYS,
        samples: Count | None = DEFAULT_SAMPLES,
        seed: int = 0,
        error_sampling: ErrorSampling = DEFAULT_ERROR_SAMPLING,
    ):
        super().__init__(scene.train, seed)
        self.scene = scene
        self.rays = self.initial_rays = rays
        self.samples = samples
        self.error_sampling = error_sampling
        self._error_sampler: ErrorSampler | None = None
        self._tiles: Tensor | None = None
        """Tiles of the last step's rays; None for uniform sampling."""
        self._block: tuple[tuple[int, int], RayBatch, Tensor | None] | None = None
        """Step and number of rays of the last joint draw, its rays, and all processes' tiles."""
        self._sampler_state: dict[str, Tensor] = {}
        """Saved state that `_error_sampler` is created from."""
        self._with_texture = False
        self._resolution_scale = 1.0

    def scale_batch(self, factor: int) -> None:
        """Multiplies rays and samples per step, for larger devices. Call before training."""
        self.rays = self.initial_rays = self.initial_rays * factor
        self.samples = None if self.samples is None else self.samples * factor

    def enable_texturelessness(self, is_enabled: bool) -> None:
        """Sets whether batches contain `texturelessness`."""
        self._with_texture = is_enabled

    def set_resolution_scale(self, scale: float) -> None:
        """Scales the target samples with the square of `Field.resolution_scale`, as the steps of a ray do."""
        self._resolution_scale = scale

    def adapt_num_rays(self, num_samples: int, steps: int = 1) -> None:
        """Moves the number of rays toward the target samples, given those of the last step, as `steps` calls would."""
        if self.samples is None:
            return
        target = self.rays * round(self.samples * self._resolution_scale**2) / max(num_samples, 1)
        limit = self.initial_rays * self.MAX_RAYS_FACTOR  # empty space would need infinitely many rays
        damping = RAY_DAMPING**steps
        self.rays = max(min(64, limit), min(limit, round(damping * self.rays + (1 - damping) * min(target, limit))))

    def update_error_map(self, errors: Float[Tensor, "R"], mask: Bool[Tensor, "R"] | None = None) -> None:
        """Records the squared errors of a step's rays, over all processes, for error sampling; `mask` as in `ErrorSampler`."""
        if self._error_sampler is not None and self._tiles is not None:
            self._error_sampler.update(self._tiles, errors, mask)

    def reset(self) -> None:
        """Resets the error map and the adaptive ray count for a new training."""
        self.rays = self.initial_rays
        self._error_sampler, self._sampler_state, self._block = None, {}, None

    def draw_batch(self, photos: Views, step: int, part: slice) -> RayBatch:
        if photos.pixels.device.type == "cpu":
            pixels, weights, self._tiles = self._draw_pixels(photos, step, self.rays)
            return make_batch(photos, pixels[part], self._with_texture, None if weights is None else weights[part])
        row = step % STEPS_PER_DRAW
        key = step - row, self.rays
        if self._block is None or self._block[0] != key:
            drawn = self._draw_pixels(photos, step - row, STEPS_PER_DRAW * self.rays)
            weights, tiles = (x if x is None else x.view(STEPS_PER_DRAW, -1) for x in drawn[1:])
            pixels = drawn[0].view(STEPS_PER_DRAW, -1)[:, part].flatten()
            own = None if weights is None else weights[:, part].flatten()
            self._block = key, make_batch(photos, pixels, self._with_texture, own), tiles
        _, block, tiles = self._block
        self._tiles, size = None if tiles is None else tiles[row], len(block.pixels) // STEPS_PER_DRAW
        return block[row * size : (row + 1) * size]

    def _draw_pixels(self, photos: Views, step: int, count: int) -> tuple[Tensor, Tensor | None, Tensor | None]:
        """Samples indices into `Views.pixels`, importance weights and tiles; the last two are None for uniform sampling."""
        generator = step_generator(self.seed, Stream.BATCH, step, photos.pixels.device)
        if self.error_sampling == 0:
            return photos.sample_pixels(count, generator), None, None
        if self._error_sampler is None or self._error_sampler.views is not photos:
            if self._error_sampler is not None:
                self._sampler_state = self._error_sampler.state_dict()
            self._error_sampler = ErrorSampler(photos, self.error_sampling)
            # The state is empty, or of other photos, if the numbers of tiles differ.
            if len(self._sampler_state.get("sums", ())) == len(self._error_sampler.sums):
                self._error_sampler.load_state_dict(self._sampler_state)
        return self._error_sampler.draw(count, generator)

    def make_baseline_batch(self) -> RayBatch:
        """Samples training pixels for the constant-color baseline."""
        generator = step_generator(self.seed, Stream.BASELINE, 0)
        return make_batch(self.scene.train, self.scene.train.sample_pixels(BASELINE_PIXELS, generator))

    def make_warmup_batch(self) -> RayBatch:
        """A small batch for compiling kernels."""
        generator = step_generator(0, Stream.BATCH, 0)
        return make_batch(self.scene.train, self.scene.train.sample_pixels(64, generator), with_texture=True)

    def find_issues(self, refines_poses: bool) -> list[SceneIssue]:
        return check_scene(self.scene, refines_poses)

    @property
    def num_held_out_views(self) -> int:
        return len(self.scene.val)

    def count_held_out_pixels(self, view: int) -> int:
        width, height = self.scene.val.cameras.size(view)
        return width * height

    def get_held_out_view(self, view: int, subset: PixelSubset = ALL_PIXELS) -> ViewBatch:
        return make_view_batch(self.scene.val, view, subset)

    def state_dict(self) -> dict[str, Any]:
        state = self._sampler_state if self._error_sampler is None else self._error_sampler.state_dict()
        return {"rays": self.rays, "error_sampler": state}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._error_sampler, self._sampler_state, self._block = None, dict(state_dict["error_sampler"]), None
        if self.samples is not None:
            self.rays = min(self.initial_rays * self.MAX_RAYS_FACTOR, state_dict["rays"])
