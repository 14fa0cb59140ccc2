"""Proposal resampling in unbounded scenes: midpoints of intervals, weights, new intervals, and the interlevel loss."""

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.gpu.launch import kernel
from nerf_lightning.kernels.proposals import WEIGHT_EPS
from nerf_lightning.kernels.resampling import PDF_EPS, IntervalMidpoints

BLOCK = 128
"""Intervals per program."""
EDGES_PER_BLOCK = 16
MAX_INTERVALS = 64
"""Maximum number of a ray's intervals, which a program holds at once."""


@triton.jit
def warp(t, enter, leave, length):
    """`cameras.bounds.warp`."""
    front, back = tl.maximum((enter - t) / length, 0.0), tl.maximum((t - leave) / length, 0.0)
    return 1 / (1 + front) - 1 / (1 + back) + (tl.minimum(tl.maximum(t, enter), leave) - enter) / length


@triton.jit
def unwarp(y, enter, leave, length):
    """`cameras.bounds.unwarp`."""
    behind = y - (leave - enter) / length
    front = 1 / (1 + tl.minimum(tl.maximum(y, -1 + 1e-6), 0.0)) - 1
    back = 1 / (1 - tl.minimum(tl.maximum(behind, 0.0), 1 - 1e-6)) - 1
    return tl.where(y < 0, enter - length * front, tl.where(behind > 0, leave + length * back, enter + length * y))


@kernel()
def locate_midpoints(
    origins, directions, near, far, s, aabb, center, half_size, unit, t_out, dt_out, count, steps, length,
    B: tl.constexpr,
):  # fmt: skip
    """Contracted positions [3, N] of midpoints, their distances, and the intervals' lengths."""
    i, axis = tl.program_id(0) * B + tl.arange(0, B)[None, :], tl.arange(0, 4)[:, None]
    is_interval, is_axis, ray = i < count, axis < 3, i // steps
    origin = tl.load(origins + 3 * ray + axis, is_interval & is_axis, 0.0)
    direction = tl.load(directions + 3 * ray + axis, is_interval & is_axis, 0.0)
    middle, half = tl.load(center + axis, is_axis, 0.0), tl.load(half_size + axis, is_axis, 1.0)
    safe = tl.where(tl.abs(direction) < 1e-9, 1e-9, direction)
    low = (tl.load(aabb + axis, is_axis, -1.0) - origin) / safe
    high = (tl.load(aabb + 3 + axis, is_axis, 1.0) - origin) / safe
    enter, leave = tl.max(tl.minimum(low, high), 0)[None, :], tl.min(tl.maximum(low, high), 0)[None, :]
    closest = tl.sum((middle - origin) * direction, 0)[None, :]
    is_hit = (enter < leave) & (closest == closest)  # NaN stays NaN
    enter, leave = tl.where(is_hit, enter, closest), tl.where(is_hit, leave, closest)
    first, last = tl.load(near + ray, is_interval, 0.0), tl.load(far + ray, is_interval, 0.0)
    begin = warp(first, enter, leave, length)
    span = warp(tl.maximum(first, last), enter, leave, length) - begin
    start = unwarp(begin + span * tl.load(s + i + ray, is_interval, 0.0), enter, leave, length)
    end = unwarp(begin + span * tl.load(s + i + ray + 1, is_interval, 0.0), enter, leave, length)
    t = (start + end) / 2
    tl.store(t_out + i, t, is_interval)
    tl.store(dt_out + i, end - start, is_interval)
    local = (origin + t * direction - middle) / half
    norm = tl.maximum(tl.max(tl.where(local == local, tl.abs(local), 0.0), 0)[None, :], 1.0)
    tl.store(unit + axis * count + i, (2 - 1 / norm) * (local / norm) * 0.25 + 0.5, is_interval & is_axis)


@kernel()
def invert_cdf(s, pdf, shift, out, steps, count, eps, S: tl.constexpr, K: tl.constexpr):
    """New edges of a ray: each old interval adds the part of its length that the inverse CDF has passed."""
    ray, k = tl.program_id(0), tl.arange(0, S)[None, :]
    is_interval = k < steps
    share = tl.load(pdf + ray * steps + k, is_interval, 0.0) + tl.where(is_interval, eps, 0.0)
    passed, safe = tl.cumsum(share, 1) - share, tl.where(is_interval, share, 1.0)
    start = tl.load(s + ray * (steps + 1) + k, is_interval, 0.0)
    width = tl.load(s + ray * (steps + 1) + k + 1, is_interval, 0.0) - start
    for first in range(0, count + 1, K):
        j = first + tl.arange(0, K)[:, None]
        u = tl.minimum(tl.maximum((j + tl.load(shift + ray)) / count, 0.0), 1.0) * tl.sum(share)
        part = tl.minimum(tl.maximum((u - passed) / safe, 0.0, tl.PropagateNan.ALL), 1.0, tl.PropagateNan.ALL)
        edge = tl.load(s + ray * (steps + 1)) + tl.sum(part * width, 1)[:, None]
        tl.store(out + ray * (count + 1) + j, edge, j <= count)


def is_supported(*weights: Tensor) -> bool:
    """Whether a program holds all intervals of a ray."""
    return max(x.shape[1] for x in weights) <= MAX_INTERVALS


def interval_midpoints(rays: Rays, bounds: Bounds, near: Tensor, far: Tensor, s: Tensor) -> IntervalMidpoints:
    """`kernels.interval_midpoints` of an unbounded scene."""
    rows, steps = len(s), s.shape[1] - 1
    unit, t, dt = s.new_empty(3, rows * steps), s.new_empty(rows, steps), s.new_empty(rows, steps)
    inputs = (x.contiguous() for x in (rays.origins, rays.directions, near, far, s))
    box = bounds.aabb, bounds.center, bounds.half_size
    grid = (triton.cdiv(t.numel(), BLOCK),)
    locate_midpoints(grid, *inputs, *box, unit, t, dt, t.numel(), steps, bounds.max_half_size, B=BLOCK)
    return unit.T, t, dt


def resample(s: Tensor, pdf: Tensor, shift: Tensor, count: int) -> Tensor:
    """`kernels.resample` of at most `MAX_INTERVALS` intervals."""
    out, inputs = s.new_empty(len(s), count + 1), (x.contiguous() for x in (s, pdf, shift))
    blocks = {"S": triton.next_power_of_2(pdf.shape[1]), "K": EDGES_PER_BLOCK}
    invert_cdf((len(s),), *inputs, out, pdf.shape[1], count, PDF_EPS, **blocks)
    return out


@kernel(num_warps=1)
def weigh_intervals(
    features, dt, grad, out, steps, bias, length, HAS_GRAD: tl.constexpr, L: tl.constexpr, S: tl.constexpr
):
    """Weights of a ray's intervals or, with HAS_GRAD, the gradient of `features`: L parts of the log-density, or density."""
    k = tl.arange(0, S)
    i, is_interval, log_density = tl.program_id(0) * steps + k, k < steps, tl.zeros([S], tl.float32) + bias
    for level in tl.static_range(L):
        log_density += tl.load(features + i * L + level, is_interval, 0.0)
    density = tl.exp(log_density) if L else tl.load(features + i, is_interval, 0.0)
    scaled = tl.load(dt + i, is_interval, 0.0) / length
    depth = density * scaled
    transmittance, transparency = tl.exp(depth - tl.cumsum(depth, 0)), tl.exp(-depth)
    weight = transmittance * (1 - transparency)
    if HAS_GRAD:
        above = tl.load(grad + i, is_interval, 0.0)
        behind = tl.sum(weight * above) - tl.cumsum(weight * above, 0)
        slope = transmittance * transparency * above - behind
        for level in tl.static_range(L):
            tl.store(out + i * L + level, depth * slope, is_interval)
        if L == 0:
            tl.store(out + i, scaled * slope, is_interval)
    else:
        tl.store(out + i, weight, is_interval)


class IntervalWeights(torch.autograd.Function):
    """`kernels.proposal_weights` or, of a density [N], `kernels.volume_weights`, for at most `MAX_INTERVALS` intervals."""

    @staticmethod
    def forward(ctx, features: Tensor, dt: Tensor, bias: float, length: float):
        features, dt, out = features.contiguous(), dt.contiguous(), torch.empty_like(dt)
        ctx.numbers = dt.shape[1], bias, length
        ctx.constants = {"L": features.shape[1] if features.dim() > 1 else 0, "S": triton.next_power_of_2(dt.shape[1])}
        weigh_intervals((len(dt),), features, dt, dt, out, *ctx.numbers, HAS_GRAD=False, **ctx.constants)
        ctx.save_for_backward(features, dt)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        features, dt = ctx.saved_tensors
        out = torch.empty_like(features)
        inputs = features, dt, grad.contiguous(), out
        weigh_intervals((len(dt),), *inputs, *ctx.numbers, HAS_GRAD=True, **ctx.constants)
        return out, None, None, None


@kernel()
def bound_weights(
    proposed_weights, proposed_edges, edges, weights, loss, grad, rays, count, steps, eps,
    K: tl.constexpr, S: tl.constexpr,
):  # fmt: skip
    """Interlevel loss of a ray and the gradient of the proposed weights; a bound adds those of all overlapping intervals."""
    ray, k, j = tl.program_id(0), tl.arange(0, K)[:, None], tl.arange(0, S)[None, :]
    main, proposed = edges + ray * (count + 1) + k, proposed_edges + ray * (steps + 1) + j
    weight = tl.load(weights + ray * count + k, k < count, 0.0)
    share = tl.load(proposed_weights + ray * steps + j, j < steps, 0.0)
    overlaps = (tl.load(proposed + 1, j < steps, 0.0) > tl.load(main, k < count, 0.0)) & (k < count)
    overlaps &= (tl.load(proposed, j < steps, 0.0) < tl.load(main + 1, k < count, 0.0)) & (j < steps)
    bound = tl.sum(tl.where(overlaps, share, 0.0), 1)[:, None]
    excess = tl.maximum(weight - bound, 0.0, tl.PropagateNan.ALL)
    relative = excess / (weight + eps)
    tl.store(loss + ray, tl.sum(excess * relative))
    slope = -2 * tl.sum(tl.where(overlaps & (excess > 0), relative, 0.0), 0)[None, :] / rays
    tl.store(grad + ray * steps + j, slope, j < steps)


class InterlevelLoss(torch.autograd.Function):
    """`kernels.interlevel_loss` of at most `MAX_INTERVALS` intervals."""

    @staticmethod
    def forward(ctx, *inputs: Tensor):
        inputs = tuple(x.contiguous() for x in inputs)
        proposed, _, _, weights = inputs
        loss, grad = weights.new_empty(len(weights)), torch.empty_like(proposed)
        sizes = len(weights), weights.shape[1], proposed.shape[1]
        K, S = (triton.next_power_of_2(size) for size in sizes[1:])
        bound_weights((len(weights),), *inputs, loss, grad, *sizes, WEIGHT_EPS, K=K, S=S)
        ctx.save_for_backward(grad)
        return loss.mean()

    @staticmethod
    def backward(ctx, above: Tensor):
        return ctx.saved_tensors[0] * above, None, None, None
