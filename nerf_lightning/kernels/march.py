"""Ray marching through an occupancy grid over the bounds."""

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import cpu, gpu
from nerf_lightning.kernels.backend import has_fast_kernel, has_gpu_kernel
from nerf_lightning.kernels.cached_constants import cache_constants

INTERVALS_PER_CHUNK = 1 << 20
"""Default number of intervals that the reference tests at a time."""
BLOCK = 4
"""Cells along a side of a block; the fast version skips empty blocks."""

Packed = tuple[Float[Tensor, "N"], Float[Tensor, "N"], Int[Tensor, "N"], Int[Tensor, "R_plus_1"]]
"""Midpoints, lengths and rays of intervals, and the offset of each ray's first interval."""


def cell_index(
    unit: Float[Tensor, "*batch 3"], resolution: int, kind: torch.dtype = torch.int64
) -> Int[Tensor, "*batch"]:
    """Flat index of the cell of a resolution^3 grid over [0, 1]^3 at each position (clamped)."""
    x, y, z = (unit * resolution).to(kind).clamp_(0, resolution - 1).unbind(-1)
    return torch.add(z, torch.add(y, x, alpha=resolution), alpha=resolution)


def offsets_from_counts(counts: Shaped[Tensor, "M"]) -> Int[Tensor, "M_plus_1"]:
    """Exclusive cumulative sum of counts (or of a mask), with the total at the end."""
    return torch.cat([_zero(counts.device), counts.cumsum(0)])


@cache_constants
def _zero(device: torch.device) -> Int[Tensor, "1"]:
    return torch.zeros(1, dtype=torch.int64, device=device)


@cache_constants
def _counting_numbers(bits: int, device: torch.device) -> Int[Tensor, "numbers"]:
    """1, 2, 3, ... 2^bits."""
    return torch.arange(1, (1 << bits) + 1, device=device)


def first_true_indices(
    capacity: int, counts: Int[Tensor, "M_plus_1"]
) -> tuple[Int[Tensor, "capacity"], Bool[Tensor, "capacity"]]:
    """Indices of the first `capacity` true entries, padded with the last one, and a mask of the real ones; no device sync.

    `counts`: `offsets_from_counts` of the entries.
    """
    order, total = _counting_numbers(capacity.bit_length(), counts.device)[:capacity], counts[-1:]
    return torch.searchsorted(counts[1:], torch.minimum(order, total)), order <= total


def _pack(
    t: Float[Tensor, "R S"], dt: Float[Tensor, "R S"], keep: Bool[Tensor, "R S"], capacity: int | None = None
) -> Packed:
    steps, flat = keep.shape[1], keep.flatten()
    if capacity is None:
        indices, offsets = flat.nonzero()[:, 0], offsets_from_counts(keep.sum(1))
        return t.flatten().index_select(0, indices), dt.flatten().index_select(0, indices), indices // steps, offsets
    counts = offsets_from_counts(flat)
    indices, is_real = first_true_indices(capacity, counts)
    length = dt.flatten().index_select(0, indices) * is_real
    return t.flatten().index_select(0, indices), length, indices // steps, counts[::steps]


def pack_intervals(edges: Float[Tensor, "R S_plus_1"], keep: Bool[Tensor, "R S"]) -> Packed:
    """Packs the kept intervals between consecutive edges of each ray."""
    start, end = edges[:, :-1], edges[:, 1:]
    return _pack((start + end) / 2, end - start, keep)


def march_reference(
    rays: Rays, bounds: Bounds, shift: Tensor, occupied: Tensor,
    samples: int, step: float, capacity: int | None = None, chunk: int = INTERVALS_PER_CHUNK,
) -> Packed:  # fmt: skip
    """`march` in plain PyTorch, for every device."""
    (near, far), resolution = bounds.near_far(rays), round(len(occupied) ** (1 / 3))
    # One more than `samples`: the shift may shorten the first step, and the last must reach the far end.
    steps = torch.arange(-0.5, samples + 1, device=shift.device) + shift[:, None]
    if bounds.unbounded:
        edges = bounds.s_to_t(rays, near, far, (steps / samples).clamp(0, 1))
    else:
        edges = torch.minimum(near[:, None] + steps.clamp_min(0) * step, far[:, None])
    start, end = edges[:, :-1], edges[:, 1:]
    t, keep = (start + end) / 2, end > start
    rows = max(1, chunk // (samples + 1))
    for first in range(0, len(rays), rows):
        part = slice(first, first + rows)
        positions = (t[part, :, None] * rays.directions[part, None]).add_(rays.origins[part, None])
        cells = cell_index(bounds.to_unit(positions), resolution, torch.int32)  # half the time of int64
        keep[part].logical_and_(occupied.index_select(0, cells.flatten()).view(cells.shape))
    return _pack(t, end - start, keep, capacity)


def march(
    rays: Rays,
    bounds: Bounds,
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    capacity: int | None = None,
    chunk: int = INTERVALS_PER_CHUNK,
) -> Packed:
    """Ray marching through the bounds that keeps the steps with a midpoint in an occupied cell.

    Args:
        rays, bounds: in world units.
        shift: jitter of each ray's steps, in steps, in [0, 1).
        occupied: cells of a cubic grid over the bounds' unit cube, last axis fastest.
        samples: steps of an unbounded ray, spaced by `Bounds.s_to_t`; inside bounds at most samples + 1.
        step: step size inside bounds.
        capacity: fixed output size, so that no host-device sync is needed. Shorter results are padded with intervals of
            length 0; rays whose `offsets` end beyond it are truncated.
        chunk: intervals that the reference tests at a time, to bound its memory.
    """
    inputs = rays.origins, rays.directions, shift
    if not bounds.unbounded and has_gpu_kernel(constants=inputs):
        return gpu.march.march(rays, bounds, shift, occupied, samples, step, capacity)
    if capacity is not None or not has_fast_kernel(constants=inputs):
        return march_reference(rays, bounds, shift, occupied, samples, step, capacity, chunk)
    marcher = RayMarcher(rays, bounds, shift, occupied, samples, step)
    return marcher.advance(torch.arange(len(rays)), samples + 1)


class RayMarcher:
    """Fast `march` that can advance in increments; same arguments."""

    def __init__(
        self,
        rays: Rays,
        bounds: Bounds,
        shift: Float[Tensor, "R"],
        occupied: Bool[Tensor, "cells"],
        samples: int,
        step: float,
    ):
        (near, far), resolution = bounds.near_far(rays), round(len(occupied) ** (1 / 3))
        cells, block_bits = resolution, occupied
        if resolution % BLOCK == 0:
            cells = resolution // BLOCK
            # Four cells in a row, read as one int32.
            rows = occupied.view(torch.int32).view(cells, BLOCK, cells, BLOCK, cells)
            block_bits = functools.reduce(torch.bitwise_or, [row for part in rows.unbind(1) for row in part.unbind(2)])
        blocks = cpu.march.MAX_BLOCK_DISTANCE * (block_bits == 0).to(torch.uint8).flatten()
        if not bounds.unbounded:
            cpu.march.compute_block_distances(blocks.view(cells, cells, cells))
        inside = bounds.content_interval(rays) if bounds.unbounded else torch.empty(0, 2)
        self.ray_limits, self.shape = (near, far, inside, shift), (bounds.half_size, bounds.unbounded)
        self.steps = samples, np.float32(step)
        grid = occupied, resolution, blocks, cells
        self.arguments = rays.origins, rays.directions, *self.ray_limits, *grid, bounds.center, *self.shape, *self.steps
        self.next_interval = torch.zeros(len(rays), dtype=torch.int32)
        """Interval at which each ray continues."""

    def advance(self, ray_indices: Int[Tensor, "A"], max_intervals: int) -> Packed:
        """Next intervals of the rays with these indices, at most `max_intervals` each; `offsets` refers to these rays."""
        intervals = torch.empty(len(ray_indices), max_intervals, dtype=torch.int32)
        counts = torch.empty_like(ray_indices)
        cpu.march.march(ray_indices, *self.arguments, max_intervals, self.next_interval, intervals, counts)
        offsets = offsets_from_counts(counts)
        total = int(offsets[-1])
        t, dt, ray = torch.empty(total), torch.empty(total), torch.empty(total, dtype=torch.int64)
        cpu.march.pack_steps(ray_indices, *self.ray_limits, *self.shape, *self.steps, intervals, offsets, t, dt, ray)
        return t, dt, ray, offsets


def ray_positions_reference(origins: Tensor, directions: Tensor, ray: Tensor, t: Tensor) -> Float[Tensor, "N 3"]:
    """`ray_positions` in plain PyTorch, for every device."""
    return origins.index_select(0, ray) + t[:, None] * directions.index_select(0, ray)


class _RayPositions(torch.autograd.Function):
    @staticmethod
    def forward(ctx, origins: Tensor, directions: Tensor, ray: Tensor, t: Tensor) -> Tensor:
        out = torch.empty(3, len(t))
        cpu.march.ray_positions(origins, directions, ray, t, out)
        ctx.save_for_backward(ray, t)
        ctx.rays = len(origins)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        ray, t = ctx.saved_tensors
        origins, directions = (grad.new_zeros(ctx.rays, 3).index_add_(0, ray, x) for x in (grad, grad * t[:, None]))
        return origins, directions, None, None


def ray_positions(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], ray: Int[Tensor, "N"], t: Float[Tensor, "N"]
) -> Float[Tensor, "N 3"]:
    """Positions at distances `t` along the rays with indices `ray`."""
    if has_fast_kernel(origins, directions, constants=(t,)):
        return _RayPositions.apply(origins, directions, ray, t)
    if has_gpu_kernel(constants=(origins, directions, t)):
        return gpu.march.ray_positions(origins, directions, ray, t)
    return ray_positions_reference(origins, directions, ray, t)


def mark_cells(marks: Int[Tensor, "cells"], mark: int, bounds: Bounds, positions: Float[Tensor, "N 3"]) -> None:
    """Writes `mark` into the cells of a cubic grid over the bounds at world positions."""
    resolution = round(len(marks) ** (1 / 3))
    if has_fast_kernel(positions):
        cpu.march.mark_cells(positions.T, bounds.center, bounds.half_size, bounds.unbounded, marks, resolution, mark)
    elif not bounds.unbounded and has_gpu_kernel(positions):
        gpu.march.mark_cells(marks, mark, bounds, positions)
    else:
        marks.index_fill_(0, cell_index(bounds.to_unit(positions), resolution), mark)
