"""Resampling of intervals in unbounded scenes."""

import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.gpu.launch import kernel
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
