"""Losses on rendering weights, and their gradients in the same pass; a program per ray."""

import torch
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.gpu.composite import BLOCK
from nerf_lightning.kernels.gpu.launch import kernel
from nerf_lightning.kernels.march import Packed
from nerf_lightning.kernels.weight_losses import NEAR_LOSS_POWER, RESIDUAL_EPS, TEXTURELESS_WEIGHT


@kernel(num_warps=1)
def penalize_weights(
    weights, residual, t, dt, offsets, texturelessness, out, grads, rays, samples, scale, distortion_factor, near_factor,
    view_factor, l1_weight, eps, POWER: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Distortion, near and view loss of a ray [3, R], and their gradients: of weights (two) and view residuals, [5, N]."""
    ray = tl.program_id(0)
    first = tl.minimum(tl.load(offsets + ray), samples).to(tl.int32)
    last = tl.minimum(tl.load(offsets + ray + 1), samples).to(tl.int32)
    l1_factor = l1_weight * tl.load(texturelessness + ray)
    total, total_s = 0.0, 0.0
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        weight = tl.load(weights + i, i < last, 0.0)
        total += tl.sum(weight)
        total_s += tl.sum(weight * (1 - scale / (tl.load(t + i, i < last, 0.0) + scale)))
    distortion, near, view, passed, passed_s = 0.0, 0.0, 0.0, 0.0, 0.0
    for begin in range(first, last, B):
        i = begin + tl.arange(0, B)
        is_sample = i < last
        weight, nearness = tl.load(weights + i, is_sample, 0.0), scale / (tl.load(t + i, is_sample, 0.0) + scale)
        s, own = 1 - nearness, weight * tl.load(dt + i, is_sample, 0.0) * nearness * nearness / (3 * scale)
        sums, sums_s = passed + tl.cumsum(weight, 0), passed_s + tl.cumsum(weight * s, 0)
        distortion += tl.sum(weight * (2 * (s * (sums - weight) - (sums_s - weight * s)) + own))
        slope = 2 * (s * (2 * sums - weight - total) - (2 * sums_s - weight * s - total_s) + own)
        tl.store(grads + i, distortion_factor * slope, is_sample)
        power = nearness
        for _ in tl.static_range(POWER - 1):
            power *= nearness
        near += tl.sum(weight * power)
        tl.store(grads + samples + i, near_factor * power, is_sample)
        x, y = tl.load(residual + 3 * i, is_sample, 0.0), tl.load(residual + 3 * i + 1, is_sample, 0.0)
        z = tl.load(residual + 3 * i + 2, is_sample, 0.0)
        squares = x * x + y * y + z * z
        size = tl.sqrt(squares + eps * eps)
        view += tl.sum(weight * (squares + l1_factor * (size - eps)))
        factor = view_factor * weight * (2 + l1_factor / size)
        tl.store(grads + 2 * samples + i, factor * x, is_sample)
        tl.store(grads + 3 * samples + i, factor * y, is_sample)
        tl.store(grads + 4 * samples + i, factor * z, is_sample)
        passed += tl.sum(weight)
        passed_s += tl.sum(weight * s)
    tl.store(out + ray, distortion_factor * distortion)
    tl.store(out + rays + ray, near_factor * near)
    tl.store(out + 2 * rays + ray, view_factor * view)


class WeightLosses(torch.autograd.Function):
    """`kernels.weight_losses`."""

    @staticmethod
    def forward(ctx, weight: Tensor, residual: Tensor, packed: Packed, scale: float, factors: tuple[float, ...], *rest):
        t, dt, _, offsets = packed
        rays, inputs = len(offsets) - 1, (x.contiguous() for x in (weight, residual, t, dt, offsets, *rest))
        out, grads = t.new_empty(3, rays), t.new_zeros(5, len(t))
        numbers = rays, len(t), scale, *(factor / rays for factor in factors), TEXTURELESS_WEIGHT, RESIDUAL_EPS
        penalize_weights((rays,), *inputs, out, grads, *numbers, POWER=NEAR_LOSS_POWER, B=BLOCK)
        ctx.save_for_backward(grads)
        return tuple(out.sum(1))

    @staticmethod
    def backward(ctx, distortion: Tensor, near: Tensor, view: Tensor):
        (grads,) = ctx.saved_tensors
        grad_weight = torch.addcmul(grads[0] * distortion, grads[1], near)
        return grad_weight, (grads[2:] * view).T, None, None, None, None
