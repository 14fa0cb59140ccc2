"""Inverse transform sampling of intervals along rays in warped distances s."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import cpu, gpu
from nerf_lightning.kernels.backend import has_fast_kernel, has_gpu_kernel

PDF_EPS = 1e-5
"""Added to all weights, so that rays without weight are divided evenly."""

IntervalMidpoints = tuple[Float[Tensor, "N 3"], Float[Tensor, "R S"], Float[Tensor, "R S"]]
"""Unit-cube positions of the N = R S midpoints, their distances and the intervals' lengths (world units)."""


def interval_midpoints_reference(rays: Rays, bounds: Bounds, near: Tensor, far: Tensor, s: Tensor) -> IntervalMidpoints:
    """`interval_midpoints` in plain PyTorch, for every device."""
    edges = bounds.s_to_t(rays, near, far, s)
    t = (edges[:, :-1] + edges[:, 1:]) / 2
    positions = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).view(-1, 3)
    return bounds.to_unit(positions), t, edges[:, 1:] - edges[:, :-1]


def interval_midpoints(
    rays: Rays, bounds: Bounds, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "R S_plus_1"]
) -> IntervalMidpoints:
    """Midpoints and lengths of intervals.

    Args:
        rays, bounds: in world units.
        near, far: distances along each ray.
        s: interval edges in [0, 1], see `Bounds.s_to_t`.
    """
    inputs = rays.origins, rays.directions, near, far, s
    if bounds.unbounded and has_gpu_kernel(constants=inputs):
        return gpu.resampling.interval_midpoints(rays, bounds, near, far, s)
    if not has_fast_kernel(constants=inputs):
        return interval_midpoints_reference(rays, bounds, near, far, s)
    count, steps = len(s), s.shape[1] - 1
    inside = bounds.content_interval(rays) if bounds.unbounded else torch.empty(0, 2)
    unit, t, dt = torch.empty(3, count * steps), torch.empty(count, steps), torch.empty(count, steps)
    box = bounds.center, bounds.half_size, bounds.unbounded
    cpu.resampling.interval_midpoints(rays.origins, rays.directions, near, far, inside, s, *box, unit, t, dt)
    return unit.T, t, dt


def invert_cdf(
    edges: Float[Tensor, "R S_plus_1"], weights: Float[Tensor, "R S"], u: Float[Tensor, "R K"]
) -> Float[Tensor, "R K"]:
    """Maps u in [0, 1] by the inverse CDF of the piecewise-constant PDF given by `weights` (NeRF, section 5.2)."""
    pdf = weights + PDF_EPS
    cdf = torch.cumsum(pdf / pdf.sum(1, keepdim=True), dim=1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf], dim=1)
    upper = torch.searchsorted(cdf, u.contiguous(), right=True).clamp(1, edges.shape[1] - 1)
    low, high = cdf.gather(1, upper - 1), cdf.gather(1, upper)
    fraction = ((u - low) / (high - low).clamp_min(1e-9)).clamp(0, 1)
    start, end = edges.gather(1, upper - 1), edges.gather(1, upper)
    return start + fraction * (end - start)


def resample_reference(s: Tensor, pdf: Tensor, shift: Tensor, count: int) -> Tensor:
    """`resample` in plain PyTorch, for every device."""
    u = (torch.arange(count + 1, device=s.device) + shift[:, None]) / count
    return invert_cdf(s, pdf, u.clamp(0, 1))


def resample(
    s: Float[Tensor, "R S_plus_1"], pdf: Float[Tensor, "R S"], shift: Float[Tensor, "R"], count: int
) -> Float[Tensor, "R K_plus_1"]:
    """Edges of `count` new intervals of equal probability (inverse transform sampling, NeRF, section 5.2).

    Args:
        s: edges of the old intervals, ascending.
        pdf: probability of each old interval; about 1 in total.
        shift: shift of each ray's edges, in new intervals.
    """
    if has_gpu_kernel(constants=(s, pdf, shift)) and gpu.resampling.is_supported(pdf):
        return gpu.resampling.resample(s, pdf, shift, count)
    if not has_fast_kernel(s, pdf, shift):
        return resample_reference(s, pdf, shift, count)
    out = torch.empty(len(s), count + 1)
    cpu.resampling.resample(s, pdf, shift, np.float32(PDF_EPS), out)
    return out
