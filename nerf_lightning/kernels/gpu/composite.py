"""Volume rendering along rays, and the filter of visible samples; a program per ray."""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.gpu.launch import kernel
from nerf_lightning.kernels.gpu.march import pad_buffers

BLOCK = 32
"""Samples of a ray at a time: one per thread of a warp."""


@kernel(num_warps=1)
def composite_rays(density, rgb, t, dt, offsets, out, samples, rays, stride, channel_stride, B: tl.constexpr):
    """Color, opacity and distance of each ray, [5, R]."""
    ray = tl.program_id(0)
    first = tl.load(offsets + ray).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    depth, red, green, blue, opacity, distance = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        is_sample = i < last
        optical_depth = tl.load(density + i, is_sample, 0.0) * tl.load(dt + i, is_sample, 0.0)
        before = depth + tl.cumsum(optical_depth, 0) - optical_depth
        weight = tl.exp(-before) * (1 - tl.exp(-optical_depth))
        color = rgb + i * stride
        red += tl.sum(weight * tl.load(color, is_sample, 0.0))
        green += tl.sum(weight * tl.load(color + channel_stride, is_sample, 0.0))
        blue += tl.sum(weight * tl.load(color + 2 * channel_stride, is_sample, 0.0))
        distance += tl.sum(weight * tl.load(t + i, is_sample, 0.0))
        opacity += tl.sum(weight)
        depth += tl.sum(optical_depth)
    tl.store(out + ray, red)
    tl.store(out + rays + ray, green)
    tl.store(out + 2 * rays + ray, blue)
    tl.store(out + 3 * rays + ray, opacity)
    tl.store(out + 4 * rays + ray, distance)


@kernel(num_warps=1)
def differentiate_rays(
    density, rgb, t, dt, offsets, out, grad, grad_density, grad_rgb, samples, rays, stride, channel_stride,
    B: tl.constexpr,
):  # fmt: skip
    """Gradients of `composite_rays`. The part behind a sample is the ray's total less the part before it."""
    ray = tl.program_id(0)
    first = tl.load(offsets + ray).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    g0, g1, g2 = tl.load(grad + ray), tl.load(grad + rays + ray), tl.load(grad + 2 * rays + ray)
    g3, g4 = tl.load(grad + 3 * rays + ray), tl.load(grad + 4 * rays + ray)
    rest = g0 * tl.load(out + ray) + g1 * tl.load(out + rays + ray) + g2 * tl.load(out + 2 * rays + ray)
    rest += g3 * tl.load(out + 3 * rays + ray) + g4 * tl.load(out + 4 * rays + ray)
    depth = 0.0
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        is_sample = i < last
        length = tl.load(dt + i, is_sample, 0.0)
        optical_depth = tl.load(density + i, is_sample, 0.0) * length
        before = depth + tl.cumsum(optical_depth, 0) - optical_depth
        transmittance, transparency = tl.exp(-before), tl.exp(-optical_depth)
        weight = transmittance * (1 - transparency)
        at = i * stride
        value = g0 * tl.load(rgb + at, is_sample, 0.0) + g1 * tl.load(rgb + at + channel_stride, is_sample, 0.0)
        value += g2 * tl.load(rgb + at + 2 * channel_stride, is_sample, 0.0) + g3 + g4 * tl.load(t + i, is_sample, 0.0)
        behind = rest - tl.cumsum(weight * value, 0)
        tl.store(grad_density + i, length * (transmittance * transparency * value - behind), is_sample)
        tl.store(grad_rgb + at, g0 * weight, is_sample)
        tl.store(grad_rgb + at + channel_stride, g1 * weight, is_sample)
        tl.store(grad_rgb + at + 2 * channel_stride, g2 * weight, is_sample)
        rest -= tl.sum(weight * value)
        depth += tl.sum(optical_depth)


class Composite(torch.autograd.Function):
    """`kernels.composite`."""

    @staticmethod
    def forward(ctx, density: Tensor, rgb: Tensor, t: Tensor, dt: Tensor, offsets: Tensor):
        density, t, dt, offsets = (x.contiguous() for x in (density, t, dt, offsets))
        rays = len(offsets) - 1
        if rgb.stride() not in ((3, 1), (1, len(t))):
            rgb = rgb.contiguous()
        out = density.new_empty(5, rays)
        shape = len(t), rays, *rgb.stride()
        composite_rays((rays,), density, rgb, t, dt, offsets, out, *shape, B=BLOCK)
        ctx.save_for_backward(density, rgb, t, dt, offsets, out)
        return out[:3].T, out[3], out[4]

    @staticmethod
    def backward(ctx, color: Tensor, opacity: Tensor, distance: Tensor):
        density, rgb, t, dt, offsets, out = ctx.saved_tensors
        grad = torch.cat([color.T, opacity[None], distance[None]])
        grad_density, grad_rgb = torch.zeros_like(density), torch.zeros_like(rgb)
        shape = len(t), out.shape[1], *rgb.stride()
        gradients = grad, grad_density, grad_rgb
        differentiate_rays((out.shape[1],), *ctx.saved_tensors, *gradients, *shape, B=BLOCK)
        return grad_density, grad_rgb, None, None, None


@triton.jit
def select_visible(
    optical_depth, dt, min_depth, i, is_sample, depth, thin, max_depth, max_dropped, IS_PADDED: tl.constexpr
):
    """Whether samples `i` of a ray are visible; also their optical depth, and those of the transparent ones."""
    own_depth = tl.load(optical_depth + i, is_sample, 0.0)
    transparent = own_depth < tl.load(min_depth)
    own_thin = tl.where(transparent, own_depth, 0.0)
    transparent &= thin + tl.cumsum(own_thin, 0) <= max_dropped
    occluded = depth + tl.cumsum(own_depth, 0) - own_depth > max_depth
    keep = is_sample & ((transparent | occluded) == 0)
    if IS_PADDED:
        keep &= tl.load(dt + i, is_sample, 0.0) > 0
    return keep, own_depth, own_thin


@kernel(num_warps=1)
def count_visible(
    optical_depth, dt, offsets, min_depth, counts, samples, max_depth, max_dropped, IS_PADDED: tl.constexpr,
    B: tl.constexpr,
):  # fmt: skip
    """Writes the visible samples of each ray, from the second entry on."""
    ray = tl.program_id(0)
    first = tl.minimum(tl.load(offsets + ray), samples).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    depth, thin, count = 0.0, 0.0, tl.zeros([], tl.int64)
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        keep, own_depth, own_thin = select_visible(
            optical_depth, dt, min_depth, i, i < last, depth, thin, max_depth, max_dropped, IS_PADDED
        )
        count += tl.sum(keep.to(tl.int64))
        depth += tl.sum(own_depth)
        thin += tl.sum(own_thin)
    tl.store(counts + 1 + ray, count)


@kernel(num_warps=1)
def write_visible(
    optical_depth, t, dt, offsets, min_depth, kept_offsets, depth_out, t_out, dt_out, ray_out,
    rays, samples, capacity, max_depth, max_dropped, IS_PADDED: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Packs the visible samples, as far as they fit."""
    ray = tl.program_id(0)
    first = tl.minimum(tl.load(offsets + ray), samples).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    next_slot = tl.load(kept_offsets + ray).to(tl.int32)
    depth, thin = 0.0, 0.0
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        keep, own_depth, own_thin = select_visible(
            optical_depth, dt, min_depth, i, i < last, depth, thin, max_depth, max_dropped, IS_PADDED
        )
        count = keep.to(tl.int32)
        slot = next_slot + tl.cumsum(count, 0) - count
        fits = keep & (slot < capacity)
        tl.store(depth_out + slot, own_depth, fits)
        tl.store(t_out + slot, tl.load(t + i, fits, 0.0), fits)
        tl.store(dt_out + slot, tl.load(dt + i, fits, 0.0), fits)
        tl.store(ray_out + slot, (ray + tl.zeros_like(slot)).to(tl.int64), fits)
        next_slot += tl.sum(count)
        depth += tl.sum(own_depth)
        thin += tl.sum(own_thin)
    pad_buffers(depth_out, t_out, dt_out, ray_out, kept_offsets, rays, capacity, B)


def filter_visible(
    optical_depth: Tensor, packed: tuple[Tensor, ...], early_stop_eps: float,
    min_optical_depth: float | Tensor, capacity: int | None, max_dropped: float,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:  # fmt: skip
    """`kernels.filter_visible`."""
    optical_depth, t, dt, offsets = (x.contiguous() for x in (optical_depth, *packed[:2], packed[3]))
    rays = len(offsets) - 1
    min_depth = torch.as_tensor(min_optical_depth, dtype=torch.float32, device=t.device)
    limits, options = (-math.log(early_stop_eps), max_dropped), {"IS_PADDED": capacity is not None, "B": BLOCK}
    counts = torch.zeros(rays + 1, dtype=torch.int64, device=t.device)
    count_visible((rays,), optical_depth, dt, offsets, min_depth, counts, len(t), *limits, **options)
    kept_offsets = counts.cumsum(0)
    size = int(kept_offsets[-1]) if capacity is None else capacity
    depths, t_out, dt_out = t.new_empty(3, size).unbind()
    ray = torch.empty(size, dtype=torch.int64, device=t.device)
    inputs = optical_depth, t, dt, offsets, min_depth, kept_offsets
    write_visible((rays,), *inputs, depths, t_out, dt_out, ray, rays, len(t), size, *limits, **options)
    return depths, (t_out, dt_out, ray, kept_offsets)
