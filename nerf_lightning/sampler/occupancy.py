"""Empty-space skipping: ray marching through the occupied cells of a coarse grid (Instant-NGP, appendix C)."""

import math
from collections.abc import Hashable
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.kernels import filter_visible, march_until_opaque
from nerf_lightning.kernels.march import BLOCK, Packed
from nerf_lightning.sampler.occupancy_grid import OccupancyGrid
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples
from nerf_lightning.utils.option_checks import Count, Ge, GridSize, Gt, Lt

RESOLUTION = 64
"""Default cells along a side."""
TRAIN_STEPS_PER_CELL, EVAL_STEPS_PER_CELL = 3, 4
"""Ray-marching steps per cell along the diagonal, for training (jittered) and for evaluation. The finer evaluation steps gain
0.3 dB on Lego and cost 17 % of render time. Cells that follow the photos' size get more: the length of a step in pixels
is constant, which gains 0.4 to 1 dB on thin parts in photos of 800 pixels."""
DENSITY_CHUNKS, MARCH_CHUNKS = 4, 32
"""Positions evaluated and marching steps tested at a time, in units of `Sampler.chunk`."""
INVISIBLE_DEPTH = 0.5 / 255
"""Maximum optical depth dropped per ray, and early-stop transmittance, in evaluation: half of one 8-bit level."""


class SampleCapacity:
    """Capacity of the fixed-size sample buffers on accelerators, where an exact count needs a host-device sync.

    On a CPU samples are always counted. Elsewhere the first step of each kind counts; later ones record their counts on
    the device, and `read_counts` reads them once per update of the cells.
    """

    HEADROOM = 1.25  # relative to the last count
    SIZE_MULTIPLE = 64  # of sizes: kernels are compiled for the alignment of their tensors

    def __init__(self) -> None:
        self.per_ray: dict[bool, tuple[float, float]] = {}
        """Steps in occupied cells and kept steps per ray at the last count, for full passes (True) and other steps."""
        self.recorded: dict[bool, tuple[int, Tensor, Tensor]] = {}
        """Rays of newer steps, and their numbers of steps on the device."""

    def sizes(self, num_rays: int, is_full_pass: bool) -> tuple[int, int] | tuple[None, None]:
        """Capacities for marched and for kept steps; None to count exactly."""
        if is_full_pass not in self.per_ray:
            return None, None
        counts = (self.HEADROOM * count * num_rays / self.SIZE_MULTIPLE for count in self.per_ray[is_full_pass])
        steps, kept = (self.SIZE_MULTIPLE * math.ceil(count) for count in counts)
        return steps, kept

    def record_counts(
        self, is_full_pass: bool, marched_offsets: Int[Tensor, "R_plus_1"], kept_offsets: Int[Tensor, "R_plus_1"]
    ) -> None:
        """Records the counts of a training step, given by the offsets of its marched and its kept steps."""
        if marched_offsets.device.type != "cpu":
            self.recorded[is_full_pass] = len(kept_offsets) - 1, marched_offsets[-1], kept_offsets[-1]
            if is_full_pass not in self.per_ray:
                self.read_counts()

    def read_counts(self) -> None:
        """Reads the recorded counts: a single host-device sync."""
        if self.recorded:
            totals = torch.stack([total for _, *row in self.recorded.values() for total in row]).tolist()
            for (kind, (rays, *_)), *row in zip(self.recorded.items(), totals[::2], totals[1::2], strict=True):
                self.per_ray[kind] = max(row[0], 1) / rays, max(row[1], 1) / rays
            self.recorded.clear()


class OccupancySampler(Sampler):
    """Uniform ray marching that keeps only samples in occupied, visible space.

    Training marches only through the `OccupancyGrid`'s active (recently visible) cells; every `update_every` steps it marches
    through all occupied ones, so that the interior of solids is rarely evaluated. The field's density at these steps then
    removes occluded and transparent samples.

    Args:
        bounds: the box of the content.
        samples: steps along the diagonal of the bounds. None: three times `resolution` in training, four times in evaluation,
            both times the field's `resolution_scale`.
        resolution: cells along each side. None: 64 times the field's `resolution_scale`.
        threshold, decay: see `OccupancyGrid`.
        update_every: training steps between updates.
        warmup: steps during which updates cover every cell; afterwards each covers a quarter of them.
        visibility_window: see `OccupancyGrid`.
        min_cameras: cells in view of fewer training cameras stay empty: a single view constrains nothing, and its camera
            would collect fog.
        early_stop_eps: transmittance below which a ray ends; at least 1/510 in evaluation.
        alpha_thre: opacity below which training drops a step; at most half the mean, so that fog trains too.
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
        self.diagonal = 2 * float(self.bounds.half_size.norm())  # on the host: reading it from a device would sync
        self.update_every = update_every
        self.warmup = warmup
        self.min_cameras = min_cameras
        self.early_stop_eps = early_stop_eps
        self.alpha_thre = alpha_thre
        self.first_step = 0
        """First training step; the warm-up counts from it."""
        self.updates = 0
        """Number of the last update."""
        self.full_pass = True
        """Whether the next training step marches through all occupied cells."""
        self.min_depth: Tensor | None = None
        """Optical depth below which training drops steps; None after an update of the cells."""
        self.capacity = SampleCapacity()

    @property
    def samples_per_ray(self) -> float | None:
        counts = self.capacity.per_ray.get(False)
        return None if counts is None else counts[1]

    @property
    def graph_key(self) -> Hashable:
        if self.full_pass or False not in self.capacity.per_ray or self.min_depth is None:
            return None
        return self.updates, self.grid.active.data_ptr(), self.min_depth.data_ptr()

    def read_counts(self) -> None:
        self.capacity.read_counts()

    @property
    def samples(self) -> int:
        """Steps along the diagonal in training."""
        return self.requested_samples or self._count_steps(TRAIN_STEPS_PER_CELL)

    @property
    def eval_samples(self) -> int:
        """Steps along the diagonal in evaluation."""
        return self.requested_samples or self._count_steps(EVAL_STEPS_PER_CELL)

    def _count_steps(self, per_cell: int) -> int:
        # The scale of cells is the square root of that of the content's width in pixels.
        scale = self.grid.resolution / RESOLUTION if self.follows_resolution_scale else 1.0
        return round(per_cell * self.grid.resolution * scale)

    @property
    def ray_chunk_size(self) -> int:
        """Rays sampled together; more on a CPU, which marches front to back a few steps at a time."""
        return max(1, self.chunk // 2) if self.grid.device.type == "cpu" else super().ray_chunk_size

    def step_size(self, samples: int) -> float:
        """Step size in world units for a number of steps along the diagonal."""
        return self.diagonal / samples

    def set_resolution_scale(self, scale: float) -> None:
        resolution = BLOCK * round(RESOLUTION / BLOCK * scale)
        if not self.follows_resolution_scale or resolution == self.grid.resolution:
            return
        samples = self.samples
        self.grid.resize(resolution)
        self.grid.optical_depth *= samples / self.samples
        self.capacity, self.min_depth = SampleCapacity(), None

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        if generator is None:
            samples, eps = self.eval_samples, max(self.early_stop_eps, INVISIBLE_DEPTH)
            shift, cells = torch.zeros_like(rays.origins[:, 0]), self.grid.occupied
            depths, packed = self._march(rays, density, shift, cells, samples, eps)
            # Evaluation must not depend on ray chunks: only training drops steps relative to the mean.
            depths, packed, _ = filter_visible(depths, packed, eps, INVISIBLE_DEPTH, max_dropped=INVISIBLE_DEPTH)
            return Samples(*packed, optical_depth=depths)
        shift = torch.rand(len(rays), generator=generator, device=rays.origins.device)
        cells = self.grid.occupied if self.full_pass else self.grid.active
        (capacity, kept_capacity), eps = self.capacity.sizes(len(rays), self.full_pass), self.early_stop_eps
        depths, packed = self._march(rays, density, shift, cells, self.samples, eps, capacity)
        if self.min_depth is None:
            self.min_depth = self.grid.mean_active_depth().mul(0.5).clamp_max(-math.log1p(-self.alpha_thre))
        _, kept, complete = filter_visible(depths, packed, eps, self.min_depth, kept_capacity)
        positions = Samples(*kept).positions(rays)
        self.grid.mark_visible(positions, self.updates)
        self.capacity.record_counts(self.full_pass, packed[3], kept[3])
        return Samples(*kept, complete, positions)

    @torch.no_grad()
    def _march(
        self,
        rays: Rays,
        density: DensityFn,
        shift: Float[Tensor, "R"],
        cells: Bool[Tensor, "cells"],
        samples: int,
        early_stop_eps: float,
        capacity: int | None = None,
    ) -> tuple[Float[Tensor, "N"], Packed]:
        """Marches through `cells`, with early termination. Returns the steps' optical depths and their intervals."""

        def optical_depth(packed: Packed) -> Float[Tensor, "N"]:
            return self._query(density, Samples(*packed).positions(rays)) * packed[1]

        arguments = rays, self.bounds, shift, cells, samples, self.step_size(samples)
        return march_until_opaque(*arguments, optical_depth, early_stop_eps, capacity, MARCH_CHUNKS * self.chunk)

    def _query(self, density: DensityFn, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Densities in chunks, in float32 (mixed precision returns half)."""
        parts = [density(part).float() for part in positions.split(DENSITY_CHUNKS * self.chunk)]
        return parts[0].detach() if len(parts) == 1 else torch.cat(parts)

    def mark_invisible_cells(self, cameras: Cameras) -> None:
        self.grid.mark_invisible_cells(cameras, self.min_cameras)

    def _load_from_state_dict(self, *arguments: Any) -> None:
        self.min_depth = None
        super()._load_from_state_dict(*arguments)

    def restart(self, step: int) -> None:
        self.first_step, self.capacity = step, SampleCapacity()

    @torch.no_grad()
    def update(self, step: int, density: DensityFn, generator: Generator) -> None:
        self.updates, phase = divmod(step, self.update_every)
        self.full_pass = not phase
        if phase:
            return
        self.read_counts()

        def optical_depth(positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
            return self._query(density, positions) * self.step_size(self.samples)

        self.grid.update(self.updates, optical_depth, step - self.first_step < self.warmup, generator)
        self.min_depth = None
