"""Ray marching, and packing of intervals into buffers of fixed size."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.gpu.launch import kernel

RAYS_PER_PROGRAM, STEPS_PER_BLOCK = 4, 128


@triton.jit
def load_rays(near, far, shift, rays, R: tl.constexpr):
    """This program's rays [R] and [R, 1], which of them exist, and their near, far and shift."""
    row = tl.program_id(0) * R + tl.arange(0, R)
    ray, is_ray = row[:, None], (row < rays)[:, None]
    ray_near, ray_far = tl.load(near + ray, is_ray, 0.0), tl.load(far + ray, is_ray, 0.0)
    return row, ray, is_ray, ray_near, ray_far, tl.load(shift + ray, is_ray, 0.0)


@triton.jit
def intersect_steps(
    origins, directions, near, far, shift, center, half_size, occupied, s, samples, step, resolution, ray, is_ray
):
    """Midpoints and lengths of the steps `s` [1, S] of rays [R, 1], and whether their cells are occupied."""
    begin = s.to(tl.float32) - 0.5 + shift
    start = tl.minimum(near + tl.maximum(begin, 0.0) * step, far, propagate_nan=tl.PropagateNan.ALL)
    end = tl.minimum(near + tl.maximum(begin + 1.0, 0.0) * step, far, propagate_nan=tl.PropagateNan.ALL)
    is_inside = is_ray & (s <= samples) & (end > start)
    t = tl.where(is_inside, (start + end) * 0.5, 0.0)
    cell = tl.zeros(t.shape, tl.int32)
    for axis in tl.static_range(3):
        direction = tl.load(directions + 3 * ray + axis, is_ray, 0.0)
        position = t * direction + tl.load(origins + 3 * ray + axis, is_ray, 0.0)
        half = tl.load(half_size + axis) + tl.zeros_like(position)
        unit = tl.div_rn(position - (tl.load(center + axis) - half), 2 * half)
        index = tl.minimum(tl.maximum((unit * resolution).to(tl.int32), 0), resolution - 1)
        cell = cell * resolution + index
    return t, end - start, is_inside & (tl.load(occupied + cell, is_inside, 0) != 0)


@kernel()
def count_steps(
    origins, directions, near, far, shift, center, half_size, occupied, counts, rays, samples, step, resolution,
    R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Writes the steps of each ray in occupied cells, from the second entry on."""
    row, ray, is_ray, ray_near, ray_far, ray_shift = load_rays(near, far, shift, rays, R)
    total = tl.zeros([R], tl.int64)
    for first in range(0, samples + 1, S):
        s = first + tl.arange(0, S)[None, :]
        _, _, keep = intersect_steps(
            origins, directions, ray_near, ray_far, ray_shift, center, half_size, occupied, s, samples, step,
            resolution, ray, is_ray,
        )  # fmt: skip
        total += tl.sum(keep.to(tl.int64), axis=1)
    tl.store(counts + 1 + row, total, row < rays)


@triton.jit
def pad_buffers(depth_out, t_out, dt_out, ray_out, offsets, rays, capacity, S: tl.constexpr):
    """Fills this program's part of the unused slots with intervals of length 0 on the last ray."""
    part = tl.cdiv(capacity, tl.num_programs(0))
    begin = tl.load(offsets + rays).to(tl.int32) + tl.program_id(0) * part
    for first in range(0, part, S):
        i = first + tl.arange(0, S)
        is_free = (i < part) & (begin + i < capacity)
        tl.store(depth_out + begin + i, 0.0, is_free)
        tl.store(t_out + begin + i, 0.0, is_free)
        tl.store(dt_out + begin + i, 0.0, is_free)
        tl.store(ray_out + begin + i, tl.zeros([S], tl.int64) + rays - 1, is_free)


@kernel()
def write_steps(
    origins, directions, near, far, shift, center, half_size, occupied, offsets, t_out, dt_out, ray_out,
    rays, samples, step, resolution, capacity,
    R: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Packs the steps in occupied cells, as far as they fit."""
    row, ray, is_ray, ray_near, ray_far, ray_shift = load_rays(near, far, shift, rays, R)
    next_slot = tl.load(offsets + row, row < rays, 0).to(tl.int32)
    for first in range(0, samples + 1, S):
        s = first + tl.arange(0, S)[None, :]
        t, dt, keep = intersect_steps(
            origins, directions, ray_near, ray_far, ray_shift, center, half_size, occupied, s, samples, step,
            resolution, ray, is_ray,
        )  # fmt: skip
        count = keep.to(tl.int32)
        slot = next_slot[:, None] + tl.cumsum(count, axis=1) - count
        fits = keep & (slot < capacity)
        tl.store(t_out + slot, t, fits)
        tl.store(dt_out + slot, dt, fits)
        tl.store(ray_out + slot, (ray + tl.zeros_like(slot)).to(tl.int64), fits)
        next_slot += tl.sum(count, axis=1)
    pad_buffers(t_out, t_out, dt_out, ray_out, offsets, rays, capacity, S)


def march(
    rays: Rays, bounds: Bounds, near: Tensor, far: Tensor, shift: Tensor, occupied: Tensor,
    samples: int, step: float, capacity: int | None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """`kernels.march` of a bounded scene."""
    count, resolution = len(rays), round(len(occupied) ** (1 / 3))
    ray_limits = (x.contiguous() for x in (near, far, shift))
    inputs = (
        rays.origins.contiguous(),
        rays.directions.contiguous(),
        *ray_limits,
        bounds.center,
        bounds.half_size,
        occupied,
    )
    grid = (triton.cdiv(count, RAYS_PER_PROGRAM),)
    blocks = {"R": RAYS_PER_PROGRAM, "S": STEPS_PER_BLOCK}
    counts = torch.zeros(count + 1, dtype=torch.int64, device=near.device)
    count_steps(grid, *inputs, counts, count, samples, step, resolution, **blocks)
    offsets = counts.cumsum(0)
    size = int(offsets[-1]) if capacity is None else capacity
    t, dt = near.new_empty(2, size).unbind()
    ray = torch.empty(size, dtype=torch.int64, device=near.device)
    write_steps(grid, *inputs, offsets, t, dt, ray, count, samples, step, resolution, size, **blocks)
    return t, dt, ray, offsets
