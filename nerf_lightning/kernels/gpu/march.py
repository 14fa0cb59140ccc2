"""Ray marching, packing of intervals into buffers of fixed size, and positions along rays."""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.gpu.launch import kernel

RAYS_PER_PROGRAM, STEPS_PER_BLOCK = 4, 64
BLOCK = 256
"""Samples per program."""


@triton.jit
def intersect_box(origins, directions, aabb, near, far, ray, is_ray):
    """`Bounds.near_far` of rays [R, 1]."""
    near, far = near + tl.zeros(ray.shape, tl.float32), far + tl.zeros(ray.shape, tl.float32)
    for axis in range(3):
        origin = tl.load(origins + 3 * ray + axis, is_ray, 0.0)
        direction = tl.load(directions + 3 * ray + axis, is_ray, 0.0)
        direction = tl.where(tl.abs(direction) < 1e-9, 1e-9, direction)
        low = tl.div_rn(tl.load(aabb + axis) - origin, direction)
        high = tl.div_rn(tl.load(aabb + 3 + axis) - origin, direction)
        enter, leave = tl.minimum(low, high, tl.PropagateNan.ALL), tl.maximum(low, high, tl.PropagateNan.ALL)
        near, far = tl.maximum(near, enter, tl.PropagateNan.ALL), tl.minimum(far, leave, tl.PropagateNan.ALL)
    return near, far


@triton.jit
def index_axis(position, axis, center, half_size, resolution):
    """Cells along an axis of a grid over the bounds."""
    half = tl.load(half_size + axis) + tl.zeros_like(position)
    unit = tl.div_rn(position - (tl.load(center + axis) - half), 2 * half)
    return tl.minimum(tl.maximum(unit * resolution, 0.0), resolution - 1.0).to(tl.int32)  # NaN: 0


@triton.jit
def find_free_slots(offsets, rays, capacity):
    """This program's part of the slots of a buffer beyond the last ray's: their number, and the first."""
    part = tl.cdiv(capacity, tl.num_programs(0))
    return part, tl.load(offsets + rays).to(tl.int32) + tl.program_id(0) * part


@triton.jit
def pad_buffers(depth_out, t_out, dt_out, ray_out, offsets, rays, capacity, S: tl.constexpr):
    """Fills this program's part of the unused slots with intervals of length 0 on the last ray."""
    part, begin = find_free_slots(offsets, rays, capacity)
    for first in range(0, part, S):
        i = first + tl.arange(0, S)
        is_free = (i < part) & (begin + i < capacity)
        tl.store(depth_out + begin + i, 0.0, is_free)
        tl.store(t_out + begin + i, 0.0, is_free)
        tl.store(dt_out + begin + i, 0.0, is_free)
        tl.store(ray_out + begin + i, tl.zeros([S], tl.int64) + rays - 1, is_free)


@kernel()
def march_rays(
    origins, directions, shift, aabb, center, half_size, occupied, limits, offsets, t_out, dt_out, ray_out,
    rays, samples, step, resolution, capacity, min_near, max_far,
    WRITES: tl.constexpr, R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Packs the steps in occupied cells, as far as they fit; or counts each ray's, from the second of `offsets` on, and
    writes its near and far limits."""
    row = tl.program_id(0) * R + tl.arange(0, R)
    ray, is_ray = row[:, None], (row < rays)[:, None]
    if WRITES:
        near, far = tl.load(limits + ray, is_ray, 0.0), tl.load(limits + rays + ray, is_ray, 0.0)
    else:
        near, far = intersect_box(origins, directions, aabb, min_near, max_far, ray, is_ray)
        tl.store(limits + ray, near, is_ray)
        tl.store(limits + rays + ray, far, is_ray)
    ray_shift, next_slot = tl.load(shift + ray, is_ray, 0.0), tl.zeros([R], tl.int32)
    if WRITES:
        next_slot = tl.load(offsets + row, row < rays, 0).to(tl.int32)
    for first in range(0, samples + 1, S):
        s = first + tl.arange(0, S)[None, :]
        begin = s.to(tl.float32) - 0.5 + ray_shift
        start = tl.minimum(near + tl.maximum(begin, 0.0) * step, far, tl.PropagateNan.ALL)
        end = tl.minimum(near + tl.maximum(begin + 1.0, 0.0) * step, far, tl.PropagateNan.ALL)
        keep = is_ray & (s <= samples) & (end > start)
        t, cell = tl.where(keep, (start + end) * 0.5, 0.0), tl.zeros([R, S], tl.int32)
        for axis in tl.static_range(3):
            direction = tl.load(directions + 3 * ray + axis, is_ray, 0.0)
            position = t * direction + tl.load(origins + 3 * ray + axis, is_ray, 0.0)
            cell = cell * resolution + index_axis(position, axis, center, half_size, resolution)
        keep &= tl.load(occupied + cell, keep, 0) != 0
        count = keep.to(tl.int32)
        if WRITES:
            slot = next_slot[:, None] + tl.cumsum(count, axis=1) - count
            fits = keep & (slot < capacity)
            tl.store(t_out + slot, t, fits)
            tl.store(dt_out + slot, end - start, fits)
            tl.store(ray_out + slot, (ray + tl.zeros_like(slot)).to(tl.int64), fits)
        next_slot += tl.sum(count, axis=1)
    if WRITES:
        pad_buffers(t_out, t_out, dt_out, ray_out, offsets, rays, capacity, S)
    else:
        tl.store(offsets, tl.zeros([], tl.int64))
        tl.store(offsets + 1 + row, next_slot.to(tl.int64), row < rays)


def march(
    rays: Rays, bounds: Bounds, shift: Tensor, occupied: Tensor, samples: int, step: float, capacity: int | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """`kernels.march` of a bounded scene."""
    count, resolution = len(rays), round(len(occupied) ** (1 / 3))
    box = bounds.box, bounds.center, bounds.half_size
    limits = shift.new_empty(2, count)
    inputs = *(x.contiguous() for x in (rays.origins, rays.directions, shift)), *box, occupied, limits
    ends = float(max(bounds.near or 0.0, 0.0)), math.inf if bounds.far is None else float(bounds.far)
    grid, blocks = (max(triton.cdiv(count, RAYS_PER_PROGRAM), 1),), {"R": RAYS_PER_PROGRAM, "S": STEPS_PER_BLOCK}
    counts = torch.empty(count + 1, dtype=torch.int64, device=shift.device)
    shape = count, samples, step, resolution
    march_rays(grid, *inputs, counts, shift, shift, counts, *shape, 0, *ends, WRITES=False, **blocks)
    offsets = counts.cumsum(0)
    size = int(offsets[-1]) if capacity is None else capacity
    t, dt = shift.new_empty(2, size).unbind()
    ray = torch.empty(size, dtype=torch.int64, device=shift.device)
    march_rays(grid, *inputs, offsets, t, dt, ray, *shape, size, *ends, WRITES=True, **blocks)
    return t, dt, ray, offsets


@kernel()
def locate_samples(origins, directions, ray, t, out, count, B: tl.constexpr):
    """Positions at distances along rays, [3, N]."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    first, distance = 3 * tl.load(ray + i, i < count, 0), tl.load(t + i, i < count, 0.0)
    for axis in tl.static_range(3):
        along = distance * tl.load(directions + first + axis, i < count, 0.0)
        tl.store(out + axis * count + i, tl.load(origins + first + axis, i < count, 0.0) + along, i < count)


def ray_positions(origins: Tensor, directions: Tensor, ray: Tensor, t: Tensor) -> Tensor:
    """`kernels.ray_positions` without gradient."""
    count, rays = len(t), (origins.contiguous(), directions.contiguous())
    out = t.new_empty(3, count)
    locate_samples((triton.cdiv(count, BLOCK),), *rays, ray.contiguous(), t.contiguous(), out, count, B=BLOCK)
    return out.T


@kernel()
def fill_cells(positions, center, half_size, marks, count, mark, resolution, B: tl.constexpr):
    """Writes `mark` into the cells at positions [3, N]."""
    i, cell = tl.program_id(0) * B + tl.arange(0, B), tl.zeros([B], tl.int32)
    for axis in tl.static_range(3):
        position = tl.load(positions + axis * count + i, i < count, 0.0)
        cell = cell * resolution + index_axis(position, axis, center, half_size, resolution)
    tl.store(marks + cell, mark, i < count)


def mark_cells(marks: Tensor, mark: int, bounds: Bounds, positions: Tensor) -> None:
    """`kernels.mark_cells` of a bounded scene."""
    count, inputs = len(positions), (positions.T.contiguous(), bounds.center, bounds.half_size, marks)
    fill_cells((triton.cdiv(count, BLOCK),), *inputs, count, mark, round(len(marks) ** (1 / 3)), B=BLOCK)
