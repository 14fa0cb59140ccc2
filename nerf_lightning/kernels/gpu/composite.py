"""Volume rendering along rays, and the filter of visible samples; a program per ray. The photometric loss."""

import math

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.gpu.launch import kernel
from nerf_lightning.kernels.gpu.march import find_free_slots, pad_buffers

BLOCK = 32
"""Samples of a ray at a time: one per thread of a warp."""
RAYS_PER_PROGRAM = 128
"""Rays per program of the photometric loss."""


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
    density, rgb, t, dt, offsets, out, color, opacity, distance, grad_density, grad_rgb, samples, rays,
    stride, channel_stride, grad_stride, grad_channel_stride, HAS_DISTANCE: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Gradients of `composite_rays`, from those of color, opacity and distance; 0 in unused slots.

    The part behind a sample is the ray's total less the part before it.
    """
    ray = tl.program_id(0)
    first = tl.load(offsets + ray).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    color += ray * grad_stride
    g0, g1 = tl.load(color), tl.load(color + grad_channel_stride)
    g2, g3 = tl.load(color + 2 * grad_channel_stride), tl.load(opacity + ray)
    g4 = tl.load(distance + ray) if HAS_DISTANCE else 0.0
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
    part, first_free = find_free_slots(offsets, rays, samples)
    for begin in range(0, part, B):
        slot = first_free + begin + tl.arange(0, B)
        is_free = (begin + tl.arange(0, B) < part) & (slot < samples)
        tl.store(grad_density + slot, 0.0, is_free)
        for channel in tl.static_range(3):
            tl.store(grad_rgb + slot * stride + channel * channel_stride, 0.0, is_free)


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
        ctx.set_materialize_grads(False)
        return out[:3].T, out[3], out[4]

    @staticmethod
    def backward(ctx, color: Tensor | None, opacity: Tensor | None, distance: Tensor | None):
        density, rgb, t, _, _, out = ctx.saved_tensors
        color = torch.zeros_like(out[:3]).T if color is None else color
        opacity = torch.zeros_like(out[3]) if opacity is None else opacity.contiguous()
        gradients = color, opacity, opacity if distance is None else distance.contiguous()
        out_gradients = torch.empty_like(density), torch.empty_like(rgb)
        shape = len(t), out.shape[1], *rgb.stride(), *color.stride()
        constants = {"HAS_DISTANCE": distance is not None, "B": BLOCK}
        differentiate_rays((out.shape[1],), *ctx.saved_tensors, *gradients, *out_gradients, *shape, **constants)
        return *out_gradients, None, None, None


@kernel(num_warps=1)
def pack_visible(
    optical_depth, t, dt, offsets, min_depth, kept_offsets, depth_out, t_out, dt_out, ray_out, complete,
    rays, samples, capacity, max_depth, max_dropped, IS_PADDED: tl.constexpr, WRITES: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Packs the visible samples, as far as they fit, and writes of which rays all do; or counts each ray's visible samples,
    from the second of `kept_offsets` on."""
    ray = tl.program_id(0)
    first = tl.minimum(tl.load(offsets + ray), samples).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    depth, thin, next_slot = 0.0, 0.0, tl.zeros([], tl.int32)
    if WRITES:
        next_slot = tl.load(kept_offsets + ray).to(tl.int32)
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        is_sample = i < last
        own_depth = tl.load(optical_depth + i, is_sample, 0.0)
        transparent = own_depth < tl.load(min_depth)
        own_thin = tl.where(transparent, own_depth, 0.0)
        transparent &= thin + tl.cumsum(own_thin, 0) <= max_dropped
        occluded = depth + tl.cumsum(own_depth, 0) - own_depth > max_depth
        keep = is_sample & ((transparent | occluded) == 0)
        if IS_PADDED:
            keep &= tl.load(dt + i, is_sample, 0.0) > 0
        count = keep.to(tl.int32)
        if WRITES:
            slot = next_slot + tl.cumsum(count, 0) - count
            fits = keep & (slot < capacity)
            tl.store(depth_out + slot, own_depth, fits)
            tl.store(t_out + slot, tl.load(t + i, fits, 0.0), fits)
            tl.store(dt_out + slot, tl.load(dt + i, fits, 0.0), fits)
            tl.store(ray_out + slot, (ray + tl.zeros_like(slot)).to(tl.int64), fits)
        next_slot += tl.sum(count)
        depth += tl.sum(own_depth)
        thin += tl.sum(own_thin)
    if WRITES:
        is_complete = (tl.load(offsets + ray + 1) <= samples) & (tl.load(kept_offsets + ray + 1) <= capacity)
        tl.store(complete + ray, is_complete.to(tl.uint8))
        pad_buffers(depth_out, t_out, dt_out, ray_out, kept_offsets, rays, capacity, B)
    else:
        tl.store(kept_offsets, tl.zeros([], tl.int64))
        tl.store(kept_offsets + 1 + ray, next_slot.to(tl.int64))


def filter_visible(
    optical_depth: Tensor, packed: tuple[Tensor, ...], early_stop_eps: float,
    min_optical_depth: float | Tensor, capacity: int | None, max_dropped: float,
) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor], Tensor | None]:  # fmt: skip
    """`kernels.filter_visible`."""
    inputs = optical_depth, t, dt, offsets = tuple(x.contiguous() for x in (optical_depth, *packed[:2], packed[3]))
    rays = len(offsets) - 1
    min_depth = torch.as_tensor(min_optical_depth, dtype=torch.float32, device=t.device)
    limits, options = (-math.log(early_stop_eps), max_dropped), {"IS_PADDED": capacity is not None, "B": BLOCK}
    counts = torch.empty(rays + 1, dtype=torch.int64, device=t.device)
    unused = t, t, t, counts, counts
    pack_visible((rays,), *inputs, min_depth, counts, *unused, rays, len(t), 0, *limits, WRITES=False, **options)
    kept_offsets = counts.cumsum(0) if rays else torch.zeros_like(counts)
    size = int(kept_offsets[-1]) if capacity is None else capacity
    depths, t_out, dt_out = t.new_empty(3, size).unbind()
    ray, complete = (
        torch.empty(n, dtype=kind, device=t.device) for n, kind in ((size, torch.int64), (rays, torch.bool))
    )
    outputs = depths, t_out, dt_out, ray, complete
    shape = rays, len(t), size
    pack_visible((rays,), *inputs, min_depth, kept_offsets, *outputs, *shape, *limits, WRITES=True, **options)
    return depths, (t_out, dt_out, ray, kept_offsets), None if capacity is None else complete


@kernel()
def compare_colors(
    foreground, opacity, backgrounds, pixels, weights, complete, errors, losses, gradients, rays, stride, channel_stride,
    background_stride, background_channel_stride, variance,
    CHANNELS: tl.constexpr, HAS_WEIGHTS: tl.constexpr, IS_PARTIAL: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Squared error of each ray, and its weighted errors [2, R] of color and opacity; gradients of their means [5, R] with
    respect to foreground and opacity, and to opacity alone."""
    ray = tl.program_id(0) * B + tl.arange(0, B)
    is_ray = ray < rays
    alpha, transparency = tl.full([B], 1.0, tl.float32), 1 - tl.load(opacity + ray, is_ray, 0.0)
    if CHANNELS == 4:
        alpha = tl.load(pixels + ray * 4 + 3, is_ray, 0).to(tl.float32) / 255
    weight = tl.load(weights + ray, is_ray, 0.0) if HAS_WEIGHTS else tl.full([B], 1.0, tl.float32)
    is_complete = tl.load(complete + ray, is_ray, 0) != 0 if IS_PARTIAL else is_ray
    error, behind = tl.zeros([B], tl.float32), tl.zeros([B], tl.float32)
    for channel in tl.static_range(3):
        background = tl.load(backgrounds + ray * background_stride + channel * background_channel_stride, is_ray, 0.0)
        truth = tl.load(pixels + ray * CHANNELS + channel, is_ray, 0).to(tl.float32) / 255
        truth = background + (truth - background) * alpha
        color = tl.load(foreground + ray * stride + channel * channel_stride, is_ray, 0.0)
        difference = tl.where(is_complete, color + transparency * background - truth, 0.0)
        slope = difference * weight * (2 / 3) / rays
        tl.store(gradients + channel * rays + ray, slope, is_ray)
        error += difference * difference / 3
        behind += slope * background
    tl.store(gradients + 3 * rays + ray, -behind, is_ray)
    excess = tl.where(is_complete, 1 - transparency - alpha, 0.0)
    tl.store(gradients + 4 * rays + ray, excess * weight * (2 * variance) / rays, is_ray)
    tl.store(errors + ray, error + variance * excess * excess, is_ray)
    tl.store(losses + ray, error * weight, is_ray)
    tl.store(losses + rays + ray, variance * excess * excess * weight, is_ray)


class PhotometricLoss(torch.autograd.Function):
    """`kernels.photometric_loss`."""

    @staticmethod
    def forward(
        ctx, foreground: Tensor, opacity: Tensor, backgrounds: Tensor, pixels: Tensor, weights: Tensor | None,
        complete: Tensor | None, variance: float,
    ):  # fmt: skip
        rays, channels = pixels.shape
        errors, losses, gradients = (opacity.new_empty(size) for size in ((rays,), (2, rays), (5, rays)))
        given = foreground, opacity.contiguous(), backgrounds, pixels.contiguous()
        masks = errors if weights is None else weights.contiguous(), pixels if complete is None else complete
        shape = rays, *foreground.stride(), *backgrounds.stride(), variance
        constants = {"CHANNELS": channels, "HAS_WEIGHTS": weights is not None, "IS_PARTIAL": complete is not None}
        grid = (triton.cdiv(rays, RAYS_PER_PROGRAM),)
        compare_colors(grid, *given, *masks, errors, losses, gradients, *shape, **constants, B=RAYS_PER_PROGRAM)
        ctx.save_for_backward(gradients)
        ctx.mark_non_differentiable(errors)
        ctx.set_materialize_grads(False)
        return *losses.mean(1).unbind(), errors

    @staticmethod
    def backward(ctx, grad: Tensor | None, grad_opacity: Tensor | None, _: None):
        (*_, for_opacity), gradients = ctx.saved_tensors[0], ctx.saved_tensors[0][:4]
        if grad is not None:
            gradients = gradients * grad
        if grad_opacity is not None:
            gradients[3].add_(for_opacity * grad_opacity)
        return gradients[:3].T, gradients[3], None, None, None, None, None
