"""Multiresolution hash encoding in 2D or 3D (Instant-NGP, Müller et al. 2022, section 3)."""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels import cpu, gpu
from nerf_lightning.kernels.backend import has_fast_kernel, has_gpu_kernel
from nerf_lightning.kernels.cached_constants import cache_constants

# Instant-NGP, eq. 4: pi_1 = 1, pi_2 = 2654435761, pi_3 = 805459861; the second as the int32 it wraps to.
PRIMES = (1, 2654435761 - 2**32, 805459861)

GridCells = tuple[int, ...]
"""Cells of a grid along each of D axes."""


def corner_count(cells: GridCells) -> int:
    """Number of vertices of a grid."""
    return math.prod(side + 1 for side in cells)


def is_dense(cells: GridCells, entries: int) -> bool:
    """Whether a table of this size has an entry for every vertex (stored in row-major order); otherwise vertices are hashed."""
    return corner_count(cells) <= entries


def axis_factors(cells: GridCells, entries: int) -> GridCells:
    """Factor of each coordinate in a vertex's entry index: stride or hash prime."""
    return tuple(corner_count(cells[:axis]) if is_dense(cells, entries) else PRIMES[axis] for axis in range(len(cells)))


def combine_axes(parts: Sequence[Tensor], dense: bool, last: int | Tensor) -> Tensor:
    """Entry indices: the sum of the axes' parts, or their XOR hash masked to the table's size.

    Args:
        parts: coordinates along each axis times its factor, 32-bit; they broadcast.
        dense: see `is_dense`.
        last: index of the table's last entry, one less than a power of two where entries are hashed.
    """
    if dense:
        return functools.reduce(torch.add, parts)
    return functools.reduce(torch.bitwise_xor, parts) & last


def entry_index(vertices: Int[Tensor, "D N"], cells: GridCells, entries: int) -> Int[Tensor, "N"]:
    """Entry index of each vertex of a grid."""
    parts = [coordinate * factor for coordinate, factor in zip(vertices, axis_factors(cells, entries), strict=True)]
    return combine_axes(parts, is_dense(cells, entries), entries - 1)


class _Levels(NamedTuple):
    """Constants of all levels, on a device."""

    cells: Float[Tensor, "L D 1"]
    first_cell: Int[Tensor, "1"]
    last_cell: Int[Tensor, "L D 1"]
    """First cell of all axes, and last cell of each."""
    axis_factors: Int[Tensor, "L D 1"]
    steps: Int[Tensor, "L D 2 1"]
    """Index offset of either end of a cell."""
    first_row: Int[Tensor, "L 1 1"]
    """First row of each level's table."""
    runs: list[tuple[slice, bool, Int[Tensor, "l *ones"]]]
    """Runs of levels that are all dense or all hashed, and the last entries of their tables."""


@cache_constants
def _levels(
    resolutions: tuple[GridCells, ...], sizes: tuple[int, ...], dtype: torch.dtype, device: torch.device
) -> _Levels:
    def int32_tensor(values: object) -> Tensor:
        return torch.tensor(values, dtype=torch.int32, device=device)

    level_factors = [axis_factors(*level) for level in zip(resolutions, sizes, strict=True)]
    dense_levels = [is_dense(*level) for level in zip(resolutions, sizes, strict=True)]
    runs, begin = [], 0
    for dense, group in itertools.groupby(dense_levels):
        part = slice(begin, begin + len(list(group)))
        last = int32_tensor([size - 1 for size in sizes[part]]).view(-1, *[1] * (len(resolutions[0]) + 1))
        runs.append((part, dense, last))
        begin = part.stop
    factors = int32_tensor(level_factors)[..., None]
    return _Levels(
        torch.tensor(resolutions, dtype=dtype, device=device)[..., None],
        int32_tensor([0]),
        int32_tensor(resolutions)[..., None] - 1,
        factors,
        torch.stack([torch.zeros_like(factors), factors], dim=2),
        int32_tensor([0, *itertools.accumulate(sizes)][:-1])[:, None, None],
        runs,
    )


def _broadcast_axis(x: Tensor, axis: int, dimensions: int) -> Tensor:
    """[L, D, 2, N] -> one axis, shaped so that its two ends broadcast over all corners: [L, 1 or 2 for each axis, N]."""
    values = x[:, axis]
    return values.view(len(values), *(2 if axis == other else 1 for other in range(dimensions)), values.shape[-1])


def hash_interpolate_reference(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N D"], resolutions: Sequence[GridCells], sizes: Sequence[int]
) -> Float[Tensor, "N LF"]:
    """`hash_interpolate` in plain PyTorch, for every device; all levels and corners at once, as GPUs are launch-bound."""
    count, dimensions = unit.shape
    levels = _levels(tuple(resolutions), tuple(sizes), unit.dtype, unit.device)
    scaled = unit.clamp(0, 1).T * levels.cells  # positions last: long, contiguous vector operations
    # NaN falls in an arbitrary cell and stays NaN in the fraction.
    cell = scaled.to(torch.int32).clamp_(levels.first_cell, levels.last_cell)
    fraction = scaled - cell
    ends = (cell * levels.axis_factors)[:, :, None] + levels.steps
    end_weights = torch.stack([1 - fraction, fraction], dim=2)
    parts = [_broadcast_axis(ends, axis, dimensions) for axis in range(dimensions)]
    index = torch.cat([combine_axes([part[run] for part in parts], dense, last) for run, dense, last in levels.runs])
    weight = functools.reduce(torch.mul, [_broadcast_axis(end_weights, axis, dimensions) for axis in range(dimensions)])
    corners = 2**dimensions
    # The CPU's index_add (the gather's gradient) is fast only for int64: 7 against 105 ms for two million.
    rows = (index.view(len(sizes), corners, count) + levels.first_row).long()
    # One gather for all levels: each gather allocates a gradient of the size of `tables`.
    entries = tables.index_select(0, rows.flatten()).view(*rows.shape, tables.shape[1])
    return (entries * weight.view(*rows.shape, 1)).sum(1).transpose(0, 1).flatten(1)


class _HashInterpolate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, tables: Tensor, unit: Tensor, resolutions: Sequence[GridCells], sizes: Sequence[int]) -> Tensor:
        coords = unit.T.contiguous()
        cells = np.array(resolutions, np.int32).reshape(len(sizes), len(coords))
        ctx.save_for_backward(tables, coords)
        ctx.levels = cells, np.array(sizes, np.int64)
        ctx.widths = (0,) * len(coords), (0,) * tables.shape[1]
        out = torch.empty(len(sizes) * tables.shape[1], len(unit))
        cpu.hashgrid.interpolate(tables, coords, *ctx.levels, out, *ctx.widths)
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None, None]:
        tables, coords = ctx.saved_tensors
        grad_tables, grad_output, grad_unit = None, grad.T.contiguous(), None
        if ctx.needs_input_grad[0]:
            grad_tables = torch.empty(tables.shape)
            cpu.hashgrid.scatter(grad_tables, coords, *ctx.levels, grad_output, *ctx.widths)
        if ctx.needs_input_grad[1]:
            grad_unit = torch.empty_like(coords)
            cpu.hashgrid.position_gradient(tables, coords, *ctx.levels, grad_output, grad_unit, *ctx.widths)
            grad_unit = grad_unit.T
        return grad_tables, grad_unit, None, None


def hash_interpolate(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N D"], resolutions: Sequence[GridCells], sizes: Sequence[int]
) -> Float[Tensor, "N LF"]:
    """Bilinear or trilinear interpolation at every level, features concatenated.

    Args:
        tables: entries of all levels, concatenated.
        unit: positions, clamped to [0, 1]^D, D = 2 or 3.
        resolutions: each level's cells along every axis.
        sizes: entries of each level's table: its number of vertices, or a power of two to hash into.
    """
    if has_fast_kernel(tables, unit):
        return _HashInterpolate.apply(tables, unit, resolutions, sizes)
    if unit.shape[1] == 3 and tables.shape[1].bit_count() == 1 and has_gpu_kernel(tables, unit):
        return gpu.hashgrid.HashInterpolate.apply(tables, unit, resolutions, sizes)
    return hash_interpolate_reference(tables, unit, resolutions, sizes)
