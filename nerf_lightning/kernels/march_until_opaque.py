"""Front-to-back ray marching with early termination."""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.march import Packed, RayMarcher, march, offsets_from_counts

FIRST_STEPS_PER_RAY = 4
"""Steps per ray in the first round; each round takes four times the steps of the one before."""


def march_until_opaque(
    rays: Rays,
    bounds: Bounds,
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    optical_depth: Callable[[Packed], Float[Tensor, "N"]],
    early_stop_eps: float,
    capacity: int | None = None,
    chunk: int = 1 << 20,
) -> tuple[Float[Tensor, "N"], Packed]:
    """Optical depths and intervals of `march`; the fast version may omit occluded ones.

    Args:
        rays, bounds, shift, occupied, samples, step, capacity, chunk: see `march`.
        optical_depth: function that returns the optical depth of intervals.
        early_stop_eps: transmittance below which a ray ends, above 0.
    """
    arguments = rays, bounds, shift, occupied, samples, step
    if capacity is not None or not has_fast_kernel(constants=(rays.origins, rays.directions, shift)):
        packed = march(*arguments, capacity, chunk)
        return optical_depth(packed), packed
    marcher, max_depth, max_intervals = RayMarcher(*arguments), -math.log(early_stop_eps), FIRST_STEPS_PER_RAY
    active, counts = torch.arange(len(rays)), torch.zeros(len(rays), dtype=torch.int64)
    optical, parts = torch.zeros(len(rays), dtype=torch.float64), []
    while len(active):
        packed = marcher.advance(active, max_intervals)
        t, dt, _, ends = packed
        depths, still_active = optical_depth(packed), torch.empty(len(active), dtype=torch.bool)
        cpu.composite.accumulate_optical_depth(depths, ends, active, max_depth, max_intervals, optical, still_active)
        counts[active] += ends.diff()
        parts.append((active, ends, depths, t, dt))
        active, max_intervals = active[still_active], 4 * max_intervals
    offsets = offsets_from_counts(counts)
    total, at = int(offsets[-1]), offsets[:-1].clone()
    out = torch.empty(total), torch.empty(total), torch.empty(total), torch.empty(total, dtype=torch.int64)
    for part in parts:
        cpu.composite.append_samples(*part, at, *out)
    return out[0], (*out[1:], offsets)
