"""Optical thickness along rays, asked of a field no farther than light reaches."""

import functools
import math
from collections.abc import Callable

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.march import Packed, march, offsets_from_counts
from nerf_lightning.kernels.switch import has_fast

BLOCK = 4
"""Cells along a side of a block; empty blocks are crossed in leaps."""
FIRST = 4
"""Steps of each ray that are asked for at first; then four times as many each time."""


def blocks_of(occupied: Bool[Tensor, "cells"], resolution: int, unbounded: bool) -> tuple[UInt8[Tensor, "blocks"], int]:
    """How many blocks of a cubic grid a leap from each one may cross, 0 where it holds something; and the blocks along a side,
    which are single cells where larger ones do not fit."""
    side, held = resolution, occupied
    if resolution % BLOCK == 0:
        side = resolution // BLOCK
        # A block's four cells in a row as one number.
        rows = occupied.view(torch.int32).view(side, BLOCK, side, BLOCK, side)
        held = functools.reduce(torch.bitwise_or, [row for part in rows.unbind(1) for row in part.unbind(2)])
    blocks = cpu.march.FAR * (held == 0).to(torch.uint8).flatten()
    if not unbounded:
        cpu.march.clear(blocks.view(side, side, side))
    return blocks, side


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
    if room is not None or not has_fast(constants=(rays.origins, rays.directions, near, far, shift)):
        packed = march(*given, room, most)
        return thickness(packed), packed
    resolution, furthest, many = round(len(occupied) ** (1 / 3)), -math.log(early_stop_eps), FIRST
    inside = bounds.inside(rays) if bounds.unbounded else torch.empty(0, 2)
    spans, size, steps = (near, far, inside, shift), (bounds.half_size, bounds.unbounded), (samples, np.float32(step))
    grid = occupied, resolution, *blocks_of(occupied, resolution, bounds.unbounded), bounds.centre
    going, after = torch.arange(len(rays)), torch.zeros(len(rays), dtype=torch.int32)
    optical, counts = torch.zeros(len(rays), dtype=torch.float64), torch.zeros(len(rays), dtype=torch.int64)
    parts = []
    while len(going):
        where, kept = torch.empty(len(going), many, dtype=torch.int32), torch.empty_like(going)
        cpu.march.walk(going, rays.origins, rays.directions, *spans, *grid, *size, *steps, many, after, where, kept)
        ends = offsets_from_counts(kept)
        t, dt, ray = (
            torch.empty(int(ends[-1])),
            torch.empty(int(ends[-1])),
            torch.empty(int(ends[-1]), dtype=torch.int64),
        )
        cpu.march.pack(going, *spans, *size, *steps, where, ends, t, dt, ray)
        found, on = thickness((t, dt, ray, ends)), torch.empty(len(going), dtype=torch.bool)
        cpu.composite.absorb(found, ends, going, furthest, many, optical, on)
        counts[going] += ends.diff()
        parts.append((going, ends, found, t, dt))
        going, many = going[on], 4 * many
    offsets = offsets_from_counts(counts)
    total, at = int(offsets[-1]), offsets[:-1].clone()
    out = torch.empty(total), torch.empty(total), torch.empty(total), torch.empty(total, dtype=torch.int64)
    for part in parts:
        cpu.composite.append(*part, at, *out)
    return out[0], (*out[1:], offsets)
