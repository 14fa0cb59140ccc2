"""Optical thickness along rays, asked of a field no farther than light reaches."""

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
"""Steps of each ray that are asked for at first; then four times as many each time."""


def march_until_opaque(
    rays: Rays,
    bounds: Bounds,
    near: Float[Tensor, "R"],
    far: Float[Tensor, "R"],
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    optical_depth: Callable[[Packed], Float[Tensor, "N"]],
    early_stop_eps: float,
    capacity: int | None = None,
    chunk: int = 1 << 20,
) -> tuple[Float[Tensor, "N"], Packed]:
    """The intervals of `march`, and the optical thickness of each; the fast version may leave out what light cannot reach.

    Args:
        rays, bounds, near, far, shift, occupied, samples, step, capacity, chunk: see `march`.
        optical_depth: of given intervals.
        early_stop_eps: early-stop transmittance, above 0: below it a ray has ended.
    """
    given = rays, bounds, near, far, shift, occupied, samples, step
    if capacity is not None or not has_fast_kernel(constants=(rays.origins, rays.directions, near, far, shift)):
        packed = march(*given, capacity, chunk)
        return optical_depth(packed), packed
    marcher, furthest, many = RayMarcher(*given), -math.log(early_stop_eps), FIRST_STEPS_PER_RAY
    going, counts = torch.arange(len(rays)), torch.zeros(len(rays), dtype=torch.int64)
    optical, parts = torch.zeros(len(rays), dtype=torch.float64), []
    while len(going):
        packed = marcher.advance(going, many)
        t, dt, _, ends = packed
        found, on = optical_depth(packed), torch.empty(len(going), dtype=torch.bool)
        cpu.composite.accumulate_optical_depth(found, ends, going, furthest, many, optical, on)
        counts[going] += ends.diff()
        parts.append((going, ends, found, t, dt))
        going, many = going[on], 4 * many
    offsets = offsets_from_counts(counts)
    total, at = int(offsets[-1]), offsets[:-1].clone()
    out = torch.empty(total), torch.empty(total), torch.empty(total), torch.empty(total, dtype=torch.int64)
    for part in parts:
        cpu.composite.append_samples(*part, at, *out)
    return out[0], (*out[1:], offsets)
