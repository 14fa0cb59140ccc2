"""Multiresolution hash encoding in 3D; a program per block of positions and level."""

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.cached_constants import cache_constants
from nerf_lightning.kernels.gpu.launch import kernel
from nerf_lightning.kernels.hashgrid import GridCells, axis_factors, is_dense

BLOCK = 128
"""Positions per program."""
LEVEL_FIELDS = 9
"""Integers per level: cells and factors along three axes, first row, last entry, and whether the level is dense."""


@cache_constants
def describe_levels(resolutions: tuple[GridCells, ...], sizes: tuple[int, ...], device: torch.device) -> Tensor:
    """Constants of each level on a device, [L, LEVEL_FIELDS]."""
    rows, first = [], 0
    for cells, size in zip(resolutions, sizes, strict=True):
        rows.append([*cells, *axis_factors(cells, size), first, size - 1, is_dense(cells, size)])
        first += size
    return torch.tensor(rows, dtype=torch.int32, device=device)


@triton.jit
def locate_cell(position, cells):
    """Cell along an axis, and the position within it. NaN falls in an arbitrary cell and stays NaN."""
    clamped = tl.maximum(position, 0.0, propagate_nan=tl.PropagateNan.ALL)
    scaled = tl.minimum(clamped, 1.0, propagate_nan=tl.PropagateNan.ALL) * cells.to(tl.float32)
    low = tl.minimum(tl.where(scaled == scaled, scaled, 0.0).to(tl.int32), cells - 1)
    return low, scaled - low.to(tl.float32)


@triton.jit
def locate(unit, i, is_position, positions, level):
    """Cells and fractions of positions `i` along each axis."""
    x, fx = locate_cell(tl.load(unit + i, is_position, 0.0), tl.load(level))
    y, fy = locate_cell(tl.load(unit + positions + i, is_position, 0.0), tl.load(level + 1))
    z, fz = locate_cell(tl.load(unit + 2 * positions + i, is_position, 0.0), tl.load(level + 2))
    return x, y, z, fx, fy, fz


@triton.jit
def index_corner(corner: tl.constexpr, x, y, z, level):
    """Row of a cell's corner in the table of all levels."""
    px = (x + (corner & 1)) * tl.load(level + 3)
    py = (y + ((corner >> 1) & 1)) * tl.load(level + 4)
    pz = (z + ((corner >> 2) & 1)) * tl.load(level + 5)
    hashed = (px ^ py ^ pz) & tl.load(level + 7)
    return tl.load(level + 6) + tl.where(tl.load(level + 8) != 0, px + py + pz, hashed)


@triton.jit
def corner_weights(corner: tl.constexpr, fx, fy, fz):
    """Factor of each axis in a corner's weight."""
    return (
        fx if corner & 1 else 1 - fx,
        fy if (corner >> 1) & 1 else 1 - fy,
        fz if (corner >> 2) & 1 else 1 - fz,
    )


@kernel()
def interpolate(
    tables, unit, levels, out, positions, FIELDS: tl.constexpr, L: tl.constexpr, F: tl.constexpr, B: tl.constexpr
):
    """Features of each position at the program's level."""
    index = tl.program_id(1)
    i, level = tl.program_id(0) * B + tl.arange(0, B), levels + index * FIELDS
    is_position = i < positions
    x, y, z, fx, fy, fz = locate(unit, i, is_position, positions, level)
    feature = tl.arange(0, F)[None, :]
    total = tl.zeros([B, F], tl.float32)
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        row = index_corner(corner, x, y, z, level)
        total += (wx * wy * wz)[:, None] * tl.load(tables + (row * F)[:, None] + feature, is_position[:, None], 0.0)
    tl.store(out + i[:, None] * (L * F) + index * F + feature, total, is_position[:, None])


@kernel()
def scatter(
    grad_tables, grad, unit, levels, positions, FIELDS: tl.constexpr, L: tl.constexpr, F: tl.constexpr, B: tl.constexpr
):
    """Adds the gradient of `interpolate` to its tables'."""
    index = tl.program_id(1)
    i, level = tl.program_id(0) * B + tl.arange(0, B), levels + index * FIELDS
    is_position = i < positions
    x, y, z, fx, fy, fz = locate(unit, i, is_position, positions, level)
    feature = tl.arange(0, F)[None, :]
    above = tl.load(grad + i[:, None] * (L * F) + index * F + feature, is_position[:, None], 0.0)
    for corner in tl.static_range(8):
        wx, wy, wz = corner_weights(corner, fx, fy, fz)
        rows = grad_tables + (index_corner(corner, x, y, z, level) * F)[:, None] + feature
        tl.atomic_add(rows, (wx * wy * wz)[:, None] * above, is_position[:, None], sem="relaxed")


@kernel()
def position_gradient(
    tables, grad, unit, levels, out, positions,
    FIELDS: tl.constexpr, L: tl.constexpr, F: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Gradient of `interpolate` with respect to its positions, [3, N]; 0 where they are clamped."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_position = i < positions
    feature = tl.arange(0, F)[None, :]
    gx, gy, gz = tl.zeros([B], tl.float32), tl.zeros([B], tl.float32), tl.zeros([B], tl.float32)
    for index in range(L):
        level = levels + index * FIELDS
        x, y, z, fx, fy, fz = locate(unit, i, is_position, positions, level)
        above = tl.load(grad + i[:, None] * (L * F) + index * F + feature, is_position[:, None], 0.0)
        for corner in tl.static_range(8):
            wx, wy, wz = corner_weights(corner, fx, fy, fz)
            row = index_corner(corner, x, y, z, level)
            value = tl.sum(above * tl.load(tables + (row * F)[:, None] + feature, is_position[:, None], 0.0), axis=1)
            gx += (1 if corner & 1 else -1) * wy * wz * value * tl.load(level).to(tl.float32)
            gy += (1 if (corner >> 1) & 1 else -1) * wx * wz * value * tl.load(level + 1).to(tl.float32)
            gz += (1 if (corner >> 2) & 1 else -1) * wx * wy * value * tl.load(level + 2).to(tl.float32)
    for axis in tl.static_range(3):
        p = tl.load(unit + axis * positions + i, is_position, 0.0)
        total = gx if axis == 0 else gy if axis == 1 else gz
        tl.store(out + axis * positions + i, tl.where((p >= 0) & (p <= 1), total, 0.0), is_position)


class HashInterpolate(torch.autograd.Function):
    """`kernels.hash_interpolate` in 3D."""

    @staticmethod
    def forward(ctx, tables: Tensor, unit: Tensor, resolutions: Sequence[GridCells], sizes: Sequence[int]) -> Tensor:
        coords, levels = unit.T.contiguous(), describe_levels(tuple(resolutions), tuple(sizes), unit.device)
        ctx.constants = {"FIELDS": LEVEL_FIELDS, "L": len(sizes), "F": tables.shape[1], "B": BLOCK}
        ctx.save_for_backward(tables, coords, levels)
        out = unit.new_empty(len(unit), len(sizes) * tables.shape[1])
        grid = triton.cdiv(len(unit), BLOCK), len(sizes)
        interpolate(grid, tables, coords, levels, out, len(unit), **ctx.constants)
        return out

    @staticmethod
    def backward(ctx, grad: Tensor):
        tables, coords, levels = ctx.saved_tensors
        grad, positions, grad_tables, grad_unit = grad.contiguous(), coords.shape[1], None, None
        grid = triton.cdiv(positions, BLOCK), len(levels)
        if ctx.needs_input_grad[0]:
            grad_tables = torch.zeros_like(tables)
            scatter(grid, grad_tables, grad, coords, levels, positions, **ctx.constants)
        if ctx.needs_input_grad[1]:
            grad_unit = torch.empty_like(coords)
            position_gradient(grid[:1], tables, grad, coords, levels, grad_unit, positions, **ctx.constants)
            grad_unit = grad_unit.T
        return grad_tables, grad_unit, None, None
