"""Skip empty space: march along rays through the occupied cells of a coarse grid (Instant-NGP, appendix C)."""

import math
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.kernels import filter_visible, march_until_opaque
from nerf_lightning.kernels.march import BLOCK, Packed
from nerf_lightning.sampler.occupancy_grid import OccupancyGrid
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples
from nerf_lightning.utils.option_checks import Count, Ge, GridSize, Gt, Lt

RESOLUTION = 64
"""Cells along a side for a field of usual size."""
TRAIN_STEPS_PER_CELL, EVAL_STEPS_PER_CELL = 3, 4
"""Along the diagonal, in training, where they begin elsewhere each time, and in pictures: on Lego at 200 and 800 pixels the
finer ones add 0.3 dB to a picture, and a sixth to its time."""
DENSITY_CHUNKS, MARCH_CHUNKS = 4, 32
"""How many positions are evaluated at a time, and how many steps are tested at a time, as multiples of `Sampler.chunk`."""
INVISIBLE_DEPTH = 0.5 / 255
"""Optical depth that rays of a picture may lose to steps that hold less, and transmittance at which they end: half of what
8 bits tell."""


class SampleCapacity:
    """How many steps along rays there is room for where they are not counted, as counting waits for the device.

    On a CPU, where nothing waits, all are counted; elsewhere once after the cells have changed.
    """

    HEADROOM = 1.25  # of the last count
    per_ray: tuple[float, float] | None = None
    """Steps in occupied cells, and how many of those were kept, at the last count; None if the next training step counts."""

    def sizes(self, num_rays: int) -> tuple[int, int] | tuple[None, None]:
        """Room for steps, and for those that are kept; None to count them."""
        if self.per_ray is None:
            return None, None
        steps, kept = (math.ceil(self.HEADROOM * count * num_rays) for count in self.per_ray)
        return steps, kept

    def record_counts(self, rays: Rays, steps: int, kept: int) -> None:
        """Takes in a count."""
        if rays.origins.device.type != "cpu":
            self.per_ray = max(steps, 1) / len(rays), max(kept, 1) / len(rays)


class OccupancySampler(Sampler):
    """Steps of one length through the bounds, kept only where there is something that light can reach.

    An `OccupancyGrid` says where to look. Training looks only at active cells, which light reached lately, except that every
    `update_every`-th step looks at all occupied ones: the inside of a solid costs nothing. The field's density is then
    evaluated along these steps, and those behind something opaque and those that hold nothing are dropped.

    Args:
        bounds: where the content is.
        samples: steps along the diagonal of the bounds; rays that cross less of it get fewer. None: three times `resolution`,
            in pictures four times.
        resolution: cells along each side. None: 64, and more where the field becomes finer than usual.
        threshold, decay: see `OccupancyGrid`.
        update_every: training steps between updates.
        warmup: steps during which updates cover every cell; afterwards each covers a quarter of them.
        visibility_window: updates after which a cell that light no longer reaches is skipped.
        min_cameras: cells seen by fewer training cameras stay empty: what only one camera sees can be anything, such as fog in
            front of its lens.
        early_stop_eps: early-stop transmittance: below it a ray has ended; in pictures at 1/510 at the latest.
        alpha_thre: alpha threshold: training drops steps of lower opacity; at most half the mean, so that fog trains too.
        chunk: see `Sampler`.
    """

    render_state = ("grid.occupied",)

    def __init__(
        self,
        bounds: Bounds,
        samples: Count | None = None,
        resolution: GridSize | None = None,
        threshold: float = 0.01,
        decay: float = 0.8,
        update_every: Count = 16,
        warmup: int = 256,
        visibility_window: Count = 8,
        min_cameras: int = 3,
        early_stop_eps: Annotated[float, Gt(0), Lt(1)] = 1e-4,
        alpha_thre: Annotated[float, Ge(0), Lt(1)] = 5e-3,
        chunk: int = CHUNK,
    ):
        super().__init__(bounds, chunk)
        self.grid = OccupancyGrid(bounds, resolution or RESOLUTION, threshold, decay, visibility_window)
        self.follows_resolution_scale = resolution is None
        self.requested_samples = samples
        self.diagonal = 2 * float(self.bounds.half_size.norm())  # a number: reading it from a device would wait
        self.update_every = update_every
        self.warmup = warmup
        self.min_cameras = min_cameras
        self.early_stop_eps = early_stop_eps
        self.alpha_thre = alpha_thre
        self.first_step = 0
        """The step at which training began; the warm-up counts from it."""
        self.updates = 0
        """Number of the last update."""
        self.full_pass = True
        """Whether the next training step looks at all occupied cells."""
        self.min_depth: Tensor | None = None
        """Optical depth below which training drops steps; None where the cells have changed since it was computed."""
        self.capacity = SampleCapacity()

    @property
    def samples(self) -> int:
        """Steps along the diagonal in training."""
        return self.requested_samples or TRAIN_STEPS_PER_CELL * self.grid.resolution

    @property
    def eval_samples(self) -> int:
        """Steps along the diagonal in pictures."""
        return self.requested_samples or EVAL_STEPS_PER_CELL * self.grid.resolution

    @property
    def ray_chunk_size(self) -> int:
        """On a CPU more than elsewhere: it goes some steps at a time along rays, front first."""
        return max(1, self.chunk // 2) if self.grid.device.type == "cpu" else super().ray_chunk_size

    def step_size(self, samples: int) -> float:
        """Length of one of so many steps, world units."""
        return self.diagonal / samples

    def set_resolution_scale(self, scale: float) -> None:
        resolution = BLOCK * round(RESOLUTION / BLOCK * scale)
        if not self.follows_resolution_scale or resolution == self.grid.resolution:
            return
        samples = self.samples
        self.grid.resize(resolution)
        self.grid.optical_depth *= samples / self.samples
        self.capacity.per_ray = self.min_depth = None

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        near, far = self.bounds.near_far(rays)
        if generator is None:
            steps, stop = self.eval_samples, max(self.early_stop_eps, INVISIBLE_DEPTH)
            found, packed = self._march(
                rays, density, near, far, torch.zeros_like(near), self.grid.occupied, steps, stop
            )
            # A picture must not depend on how its rays are split into calls: only training uses the mean to drop steps.
            found, packed = filter_visible(found, packed, stop, INVISIBLE_DEPTH, max_dropped=INVISIBLE_DEPTH)
            return Samples(*packed, optical_depth=found)
        shift = torch.rand(near.shape, generator=generator, device=near.device)
        cells = self.grid.occupied if self.full_pass else self.grid.active
        capacity, kept_capacity = self.capacity.sizes(len(rays))
        found, packed = self._march(rays, density, near, far, shift, cells, self.samples, self.early_stop_eps, capacity)
        if self.min_depth is None:
            self.min_depth = self.grid.mean_active_depth().mul(0.5).clamp_max(-math.log1p(-self.alpha_thre))
        _, kept = filter_visible(found, packed, self.early_stop_eps, self.min_depth, kept_capacity)
        positions = Samples(*kept).positions(rays)
        self.grid.mark_visible(positions, self.updates)
        if capacity is not None and kept_capacity is not None:
            complete = (packed[3][1:] <= capacity) & (kept[3][1:] <= kept_capacity)
            return Samples(*kept, complete, positions)
        self.capacity.record_counts(rays, len(found), len(kept[0]))
        return Samples(*kept, cached_positions=positions)

    @torch.no_grad()
    def _march(
        self,
        rays: Rays,
        density: DensityFn,
        near: Float[Tensor, "R"],
        far: Float[Tensor, "R"],
        shift: Float[Tensor, "R"],
        cells: Bool[Tensor, "cells"],
        samples: int,
        stop: float,
        capacity: int | None = None,
    ) -> tuple[Float[Tensor, "N"], Packed]:
        """Steps in some cells and the optical depth of each, as far as light reaches."""

        def optical_depth(packed: Packed) -> Float[Tensor, "N"]:
            return self._query(density, Samples(*packed).positions(rays)) * packed[1]

        given = rays, self.bounds, near, far, shift, cells, samples, self.step_size(samples)
        return march_until_opaque(*given, optical_depth, stop, capacity, MARCH_CHUNKS * self.chunk)

    def _query(self, density: DensityFn, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Densities, some positions at a time; mixed precision gives them in half precision."""
        found = [density(part).float() for part in positions.split(DENSITY_CHUNKS * self.chunk)]
        return found[0].detach() if len(found) == 1 else torch.cat(found)

    def mark_invisible_cells(self, cameras: Cameras) -> None:
        self.grid.mark_invisible_cells(cameras, self.min_cameras)

    def _load_from_state_dict(self, *given: Any) -> None:
        self.min_depth = None
        super()._load_from_state_dict(*given)

    def restart(self, step: int) -> None:
        self.first_step = step
        self.capacity.per_ray = None

    @torch.no_grad()
    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        self.updates, phase = divmod(step, self.update_every)
        self.full_pass = not phase
        if phase <= 1:  # the cells differ from those of the step before
            self.capacity.per_ray = None
        if phase:
            return

        def optical_depth(positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
            return self._query(density, positions) * self.step_size(self.samples)

        self.grid.update(self.updates, optical_depth, step - self.first_step < self.warmup, generator)
        self.min_depth = None
