"""Where rays cross the occupied cells of a grid over the bounds."""

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.constants import constant
from nerf_lightning.kernels.switch import has_fast

Packed = tuple[Float[Tensor, "N"], Float[Tensor, "N"], Int[Tensor, "N"], Int[Tensor, "R_plus_1"]]
"""Midpoint and length of each interval, its ray, and where each ray's intervals begin."""


def cell_index(
    unit: Float[Tensor, "*batch 3"], resolution: int, kind: torch.dtype = torch.int64
) -> Int[Tensor, "*batch"]:
    """Flat index of the cell of a resolution^3 grid over [0, 1]^3 that holds each position (clamped into the grid)."""
    x, y, z = (unit * resolution).to(kind).clamp_(0, resolution - 1).unbind(-1)
    return torch.add(z, torch.add(y, x, alpha=resolution), alpha=resolution)


def offsets_from_counts(counts: Shaped[Tensor, "M"]) -> Int[Tensor, "M_plus_1"]:
    """The sum of the counts before each one, and of all: of a mask, how many entries are true."""
    return torch.cat([_nothing(counts.device), counts.cumsum(0)])


@constant
def _nothing(device: torch.device) -> Int[Tensor, "1"]:
    return torch.zeros(1, dtype=torch.int64, device=device)


@constant
def _numbers(bits: int, device: torch.device) -> Int[Tensor, "numbers"]:
    """1, 2, 3, ... 2^bits."""
    return torch.arange(1, (1 << bits) + 1, device=device)


def within(room: int, counts: Int[Tensor, "M_plus_1"]) -> tuple[Int[Tensor, "room"], Bool[Tensor, "room"]]:
    """Indices of the first `room` true entries, and which are real: the host need not wait for a count.

    Where fewer than `room` are true, the last one is repeated. `counts`: `offsets_from_counts` of the entries.
    """
    order, total = _numbers(room.bit_length(), counts.device)[:room], counts[-1:]
    return torch.searchsorted(counts[1:], torch.minimum(order, total)), order <= total


def _pack(
    t: Float[Tensor, "R S"], dt: Float[Tensor, "R S"], keep: Bool[Tensor, "R S"], room: int | None = None
) -> Packed:
    steps, flat = keep.shape[1], keep.flatten()
    if room is None:
        chosen, offsets = flat.nonzero()[:, 0], offsets_from_counts(keep.sum(1))
        return t.flatten().index_select(0, chosen), dt.flatten().index_select(0, chosen), chosen // steps, offsets
    counts = offsets_from_counts(flat)
    chosen, there = within(room, counts)
    length = dt.flatten().index_select(0, chosen) * there
    return t.flatten().index_select(0, chosen), length, chosen // steps, counts[::steps]


def pack_intervals(edges: Float[Tensor, "R S_plus_1"], keep: Bool[Tensor, "R S"]) -> Packed:
    """Packs the kept intervals between consecutive edges of each ray."""
    start, end = edges[:, :-1], edges[:, 1:]
    return _pack((start + end) / 2, end - start, keep)


def march(
    rays: Rays,
    bounds: Bounds,
    near: Float[Tensor, "R"],
    far: Float[Tensor, "R"],
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    room: int | None = None,
    most: int = 1 << 20,
) -> Packed:
    """Equal steps from near to far; keeps those whose midpoint lies in an occupied cell. In plain PyTorch, for every device.

    Args:
        rays, bounds: in world units.
        near, far: distances along each ray; a ray with near >= far gets nothing.
        shift: moves each ray's steps along it, as a share of a step, in [0, 1).
        occupied: cells of a cubic grid over the bounds' unit cube, last axis fastest.
        samples: steps of an unbounded ray, spaced as `Bounds.distances` says; at most this many (and one) inside bounds.
        step: length of a step inside bounds.
        room: how many entries to make whatever is found, so that the host need not wait for a count. If fewer are found, the
            last interval is repeated with length 0; if more, rays whose `offsets` end beyond `room` lack some.
        most: intervals tested at a time, which bounds the memory needed.
    """
    resolution = round(len(occupied) ** (1 / 3))
    # One more than `samples`: the shift may cut the first one short, and the last must reach the far end.
    steps = torch.arange(-0.5, samples + 1, device=near.device) + shift[:, None]
    if bounds.unbounded:
        edges = bounds.distances(rays, near, far, (steps / samples).clamp(0, 1))
    else:
        edges = torch.minimum(near[:, None] + steps.clamp_min(0) * step, far[:, None])
    start, end = edges[:, :-1], edges[:, 1:]
    t, keep = (start + end) / 2, end > start
    rows = max(1, most // (samples + 1))
    for first in range(0, len(rays), rows):
        part = slice(first, first + rows)
        places = (t[part, :, None] * rays.directions[part, None]).add_(rays.origins[part, None])
        cells = cell_index(bounds.to_unit(places), resolution, torch.int32)  # half the time of int64
        keep[part].logical_and_(occupied.index_select(0, cells.flatten()).view(cells.shape))
    return _pack(t, end - start, keep, room)


def points_reference(origins: Tensor, directions: Tensor, ray: Tensor, t: Tensor) -> Float[Tensor, "N 3"]:
    """`points` in plain PyTorch, for every device."""
    return origins.index_select(0, ray) + t[:, None] * directions.index_select(0, ray)


class _Points(torch.autograd.Function):
    @staticmethod
    def forward(ctx, origins: Tensor, directions: Tensor, ray: Tensor, t: Tensor) -> Tensor:
        out = torch.empty(3, len(t))
        cpu.march.points(origins, directions, ray, t, out)
        ctx.save_for_backward(ray, t)
        ctx.rays = len(origins)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        ray, t = ctx.saved_tensors
        origins, directions = (grad.new_zeros(ctx.rays, 3).index_add_(0, ray, x) for x in (grad, grad * t[:, None]))
        return origins, directions, None, None


def points(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], ray: Int[Tensor, "N"], t: Float[Tensor, "N"]
) -> Float[Tensor, "N 3"]:
    """Positions at distances `t` along rays; `ray` holds each position's ray."""
    if not has_fast(origins, directions, constants=(t,)):
        return points_reference(origins, directions, ray, t)
    return _Points.apply(origins, directions, ray, t)


def mark_cells(marks: Int[Tensor, "cells"], mark: int, bounds: Bounds, positions: Float[Tensor, "N 3"]) -> None:
    """Writes `mark` into each cell of a cubic grid over the bounds that holds any of the positions (world units)."""
    resolution = round(len(marks) ** (1 / 3))
    if has_fast(positions):
        cpu.march.mark(positions.T, bounds.centre, bounds.half_size, bounds.unbounded, marks, resolution, mark)
    else:
        marks.index_fill_(0, cell_index(bounds.to_unit(positions), resolution), mark)
