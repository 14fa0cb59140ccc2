"""Optical thickness along rays, asked of a field no farther than light reaches."""

import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.march import Packed, Walk, march, walks

FIRST = 4
"""Steps of each ray that are asked for at first; then four times as many each time."""


def front_first(
    rays: Rays,
    bounds: Bounds,
    near: Float[Tensor, "R"],
    far: Float[Tensor, "R"],
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    thickness: Callable[[Packed], Float[Tensor, "N"]],
    early_stop_eps: float,
    room: int | None = None,
    most: int = 1 << 20,
) -> tuple[Float[Tensor, "N"], Packed]:
    """The intervals of `march`, and the optical thickness of each; the fast version may leave out what light cannot reach.

    Args:
        rays, bounds, near, far, shift, occupied, samples, step, room, most: see `march`.
        thickness: of given intervals.
        early_stop_eps: early-stop transmittance, above 0: below it a ray has ended.
    """
    given = rays, bounds, near, far, shift, occupied, samples, step
    if room is not None or not walks(rays, near, far, shift):
        packed = march(*given, room, most)
        return thickness(packed), packed
    from nerf_lightning.kernels.cpu import composite, workers

    walk, furthest, many = Walk(*given), -math.log(early_stop_eps), FIRST
    going, optical, counts = torch.arange(len(rays)), np.zeros(len(rays)), np.zeros(len(rays), np.int64)
    parts = []
    while len(going):
        packed = walk.on(going, many)
        t, dt, _, ends = (x.numpy() for x in packed)
        found, which, on = thickness(packed).numpy(), going.numpy(), np.empty(len(going), np.bool_)
        composite.absorb(found, ends, which, furthest, many, optical, on, workers())
        counts[which] += np.diff(ends)
        parts.append((which, ends, found, t, dt))
        going, many = going[torch.from_numpy(on)], 4 * many
    offsets = torch.zeros(len(rays) + 1, dtype=torch.int64)
    np.cumsum(counts, out=offsets.numpy()[1:])
    total, at = int(offsets[-1]), offsets.numpy()[:-1].copy()
    out = torch.empty(total), torch.empty(total), torch.empty(total), torch.empty(total, dtype=torch.int64)
    for part in parts:
        composite.append(*part, at, *(x.numpy() for x in out), workers())
    return out[0], (*out[1:], offsets)
