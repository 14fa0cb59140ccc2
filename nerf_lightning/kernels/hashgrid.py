"""Linear interpolation on nested grids with hashed entries, in 2D or 3D (Instant-NGP, Müller et al. 2022, section 3)."""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.cached_constants import cache_constants

# Instant-NGP, eq. 4: pi_1 = 1, pi_2 = 2654435761, pi_3 = 805459861; the second as the int32 it wraps to.
PRIMES = (1, 2654435761 - 2**32, 805459861)

GridCells = tuple[int, ...]
"""Cells of a grid along each of D axes."""


def corner_count(cells: GridCells) -> int:
    """Corners of all cells of a grid."""
    return math.prod(side + 1 for side in cells)


def is_dense(cells: GridCells, entries: int) -> bool:
    """Whether all corners of a grid fit in a table, which then holds them row by row; else they are hashed."""
    return corner_count(cells) <= entries


def axis_factors(cells: GridCells, entries: int) -> GridCells:
    """What the coordinate along each axis is multiplied by in the number of a corner's entry."""
    return tuple(corner_count(cells[:axis]) if is_dense(cells, entries) else PRIMES[axis] for axis in range(len(cells)))


def combine_axes(parts: Sequence[Tensor], dense: bool, last: int | Tensor) -> Tensor:
    """Numbers of entries: the sum of what the axes contribute, or as many bits of their hash as fit in a table.

    Args:
        parts: places along each axis times its factor, 32-bit; they broadcast.
        dense: see `is_dense`.
        last: number of the table's last entry, one less than a power of two where entries are hashed.
    """
    if dense:
        return functools.reduce(torch.add, parts)
    return functools.reduce(torch.bitwise_xor, parts) & last


def entry_index(vertices: Int[Tensor, "D N"], cells: GridCells, entries: int) -> Int[Tensor, "N"]:
    """The entry of a table that holds each vertex of a grid."""
    parts = [place * factor for place, factor in zip(vertices, axis_factors(cells, entries), strict=True)]
    return combine_axes(parts, is_dense(cells, entries), entries - 1)


class _Levels(NamedTuple):
    """The constants of all levels, on a device."""

    cells: Float[Tensor, "L D 1"]
    first_cell: Int[Tensor, "1"]
    last_cell: Int[Tensor, "L D 1"]
    """The first cell of all axes, and the last of each."""
    axis_factors: Int[Tensor, "L D 1"]
    steps: Int[Tensor, "L D 2 1"]
    """What either end of a cell adds."""
    first_row: Int[Tensor, "L 1 1"]
    """Where each level's table begins."""
    runs: list[tuple[slice, bool, Int[Tensor, "l *ones"]]]
    """Consecutive levels that are all dense or all hashed, and the last entries of their tables."""


@cache_constants
def _levels(
    resolutions: tuple[GridCells, ...], sizes: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> _Levels:
    """The constants that `hash_interpolate_reference` reads."""

    def whole(values: object) -> Tensor:
        return torch.tensor(values, dtype=torch.int32, device=device)

    table = [axis_factors(*level) for level in zip(resolutions, sizes, strict=True)]
    kinds = [is_dense(*level) for level in zip(resolutions, sizes, strict=True)]
    runs, begin = [], 0
    for dense, group in itertools.groupby(kinds):
        part = slice(begin, begin + len(list(group)))
        last = whole([size - 1 for size in sizes[part]]).view(-1, *[1] * (len(resolutions[0]) + 1))
        runs.append((part, dense, last))
        begin = part.stop
    each = whole(table)[..., None]
    return _Levels(
        torch.tensor(resolutions, dtype=dtype, device=device)[..., None],
        whole([0]),
        whole(resolutions)[..., None] - 1,
        each,
        torch.stack([torch.zeros_like(each), each], dim=2),
        whole([0, *itertools.accumulate(sizes)][:-1])[:, None, None],
        runs,
    )


def _broadcast_axis(x: Tensor, axis: int, dimensions: int) -> Tensor:
    """[L, D, 2, N] -> one axis, shaped so that its two ends broadcast over all corners: [L, 1 or 2 for each axis, N]."""
    one = x[:, axis]
    return one.view(len(one), *(2 if axis == other else 1 for other in range(dimensions)), one.shape[-1])


def hash_interpolate_reference(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N D"], resolutions: Sequence[GridCells], sizes: Sequence[int]
) -> Float[Tensor, "N LF"]:
    """`hash_interpolate` in plain PyTorch, for every device and differentiable in the positions too; in D dimensions.

    All levels and corners together: on a GPU the number of operations counts.
    """
    count, dimensions = unit.shape
    levels = _levels(tuple(resolutions), tuple(sizes), unit.dtype, unit.device)
    scaled = unit.clamp(0, 1).T * levels.cells  # positions run last: long, contiguous vector operations
    # NaN stays NaN, in some cell.
    cell = scaled.to(torch.int32).clamp_(levels.first_cell, levels.last_cell)
    fraction = scaled - cell
    ends = (cell * levels.axis_factors)[:, :, None] + levels.steps
    shares = torch.stack([1 - fraction, fraction], dim=2)
    parts = [_broadcast_axis(ends, axis, dimensions) for axis in range(dimensions)]
    index = torch.cat([combine_axes([part[run] for part in parts], dense, last) for run, dense, last in levels.runs])
    weight = functools.reduce(torch.mul, [_broadcast_axis(shares, axis, dimensions) for axis in range(dimensions)])
    corners = 2**dimensions
    # The CPU's index_add (the gather's gradient) is fast for int64 alone: 7 against 105 ms for two million.
    rows = (index.view(len(sizes), corners, count) + levels.first_row).long()
    # One gather for all levels: each gather's gradient is as large as the whole of `tables`.
    entries = tables.index_select(0, rows.flatten()).view(*rows.shape, tables.shape[1])
    return (entries * weight.view(*rows.shape, 1)).sum(1).transpose(0, 1).flatten(1)


class _HashInterpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tables: Tensor, unit: Tensor, resolutions: Sequence[GridCells], sizes: Sequence[int]) -> Tensor:
        places = unit.T.contiguous()
        cells = np.array(resolutions, np.int32).reshape(len(sizes), len(places))
        ctx.save_for_backward(tables, places)
        ctx.levels = cells, np.array(sizes, np.int64)
        ctx.widths = (0,) * len(places), (0,) * tables.shape[1]
        out = torch.empty(len(sizes) * tables.shape[1], len(unit))
        cpu.hashgrid.interpolate(tables, places, *ctx.levels, out, *ctx.widths)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        tables, places = ctx.saved_tensors
        learned, grad_output, moved = None, grad.T.contiguous(), None
        if ctx.needs_input_grad[0]:
            learned = torch.empty(tables.shape)
            cpu.hashgrid.scatter(learned, places, *ctx.levels, grad_output, *ctx.widths)
        if ctx.needs_input_grad[1]:
            moved = torch.empty_like(places)
            cpu.hashgrid.position_gradient(tables, places, *ctx.levels, grad_output, moved, *ctx.widths)
            moved = moved.T
        return learned, moved, None, None


def hash_interpolate(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N D"], resolutions: Sequence[GridCells], sizes: Sequence[int]
) -> Float[Tensor, "N LF"]:
    """Bilinear or trilinear interpolation at every level, features side by side.

    Args:
        tables: the levels' entries, one level after the other.
        unit: positions in [0, 1]^D, D = 2 or 3; outside they are clamped.
        resolutions: each level's cells along every axis.
        sizes: entries of each level's table: all corners of its grid, or a power of two to hash into.
    """
    if has_fast_kernel(tables, unit):
        return _HashInterpolate.apply(tables, unit, resolutions, sizes)
    return hash_interpolate_reference(tables, unit, resolutions, sizes)
