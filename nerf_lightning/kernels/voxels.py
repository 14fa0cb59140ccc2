"""Trilinear interpolation on a sparse voxel grid: an index over all vertices gives their rows.

Row 0 is shared by all pruned vertices: its values are constant and get no gradient.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.cached_constants import cache_constants


def grid_side(index: Int[Tensor, "cells"]) -> int:
    """Vertices along each side of a cubic grid."""
    return round(len(index) ** (1 / 3))


@cache_constants
def _steps(side: int, device: torch.device) -> tuple[Int[Tensor, "3"], Int[Tensor, "8"]]:
    """Strides of the vertex index along each axis, and index offsets of a cell's corners."""
    ends = torch.arange(2, device=device)
    corners = (ends[:, None, None] * side + ends[:, None]) * side + ends
    return torch.tensor([side * side, side, 1], device=device), corners.flatten()


def locate_vertices_reference(
    index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
    """`locate_vertices` in plain PyTorch, for every device and differentiable in the positions."""
    side = grid_side(index)
    strides, corners = _steps(side, unit.device)
    scaled = unit.clamp(0, 1) * (side - 1)
    cell = scaled.long().clamp_(0, side - 2)  # NaN becomes the smallest integer
    fraction = scaled - cell
    x, y, z = torch.stack([1 - fraction, fraction], dim=2).unbind(1)
    weights = (x[:, :, None] * y[:, None])[..., None] * z[:, None, None]
    vertices = (cell * strides).sum(1, keepdim=True) + corners
    return index.index_select(0, vertices.flatten()).view(-1, 8), weights.flatten(1)


class _LocateVertices(torch.autograd.Function):
    @staticmethod
    def forward(ctx, index: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
        coords, cells = unit.T.contiguous(), grid_side(index) - 1
        rows, weights = torch.empty(len(unit), 8, dtype=torch.int32), torch.empty(len(unit), 8)
        cpu.voxels.locate_vertices(index, cells, coords, rows, weights)
        ctx.save_for_backward(coords)
        ctx.cells = cells
        ctx.mark_non_differentiable(rows)
        return rows, weights

    @staticmethod
    def backward(ctx, _: Tensor, grad_output: Tensor) -> tuple[None, Tensor]:
        (coords,) = ctx.saved_tensors
        grad = torch.empty_like(coords)
        cpu.voxels.position_gradient(ctx.cells, coords, grad_output, grad)
        return None, grad.T


def locate_vertices(
    index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
    """Rows and trilinear weights of the eight vertices around each position, last axis fastest.

    Args:
        index: row of every vertex of a cubic grid over the unit cube, 32-bit, last axis fastest.
        unit: positions, clamped to [0, 1]^3.
    """
    return _LocateVertices.apply(index, unit) if has_fast_kernel(unit) else locate_vertices_reference(index, unit)


def mark_rows(last_read_step: Int[Tensor, "V"], rows: Int[Tensor, "N 8"], step: int) -> None:
    """Writes `step` into `last_read_step` at `rows`; both tensors are 32-bit."""
    if not has_fast_kernel(last_read_step):
        last_read_step.index_fill_(0, rows.flatten().long(), step)
    else:
        cpu.voxels.mark_rows(last_read_step, rows, step)


def interpolate_rows(
    values: Float[Tensor, "V *F"], rows: Int[Tensor, "N 8"], weights: Float[Tensor, "N 8"]
) -> Float[Tensor, "N *F"]:
    """Interpolates any number of features per vertex, in plain PyTorch."""
    values = torch.cat([values[:1].detach(), values[1:]])
    corner_values = values.index_select(0, rows.flatten()).view(*rows.shape, *values.shape[1:])
    return (corner_values * weights.view(*weights.shape, *[1] * (values.dim() - 1))).sum(1)


def interpolate_scalar(
    values: Float[Tensor, "V"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N"]:
    """Interpolates one value per vertex at positions in [0, 1]^3; the fast version has no gradients."""
    if not has_fast_kernel(values, unit, constants=(values, unit) if torch.is_grad_enabled() else ()):
        return interpolate_rows(values, *locate_vertices_reference(index, unit))
    out = torch.empty(len(unit))
    cpu.voxels.interpolate(values, index, grid_side(index) - 1, unit.T, out)
    return out


class _InterpolateVoxels(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, density: Tensor, color: Tensor, sh_coefficients: Tensor, rows: Tensor, weights: Tensor, basis: Tensor
    ) -> tuple[Tensor, Tensor]:
        raw, rgb, basis = torch.empty(len(rows)), torch.empty(3, len(rows)), basis.T.contiguous()
        cpu.voxels.read(density, color, rows, weights, raw, rgb)
        if len(basis):
            cpu.voxels.add_sh_color(sh_coefficients, rows, weights, basis, rgb, (0,) * len(basis))
        ctx.save_for_backward(density, color, sh_coefficients, rows, weights, basis)
        return raw, rgb.T

    @staticmethod
    def backward(ctx, raw: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor, None, Tensor | None, None]:
        *tables, rows, weights, basis = ctx.saved_tensors
        rgb, grad_weights, lanes = rgb.T.contiguous(), None, (0,) * len(basis)
        density, color, sh_coefficients = (torch.zeros(table.shape) for table in tables)
        cpu.voxels.scatter(density, color, rows, weights, raw, rgb)
        if lanes:
            cpu.voxels.scatter_sh(sh_coefficients, rows, weights, basis, rgb, lanes)
        if ctx.needs_input_grad[4]:
            grad_weights = torch.empty(weights.shape)
            cpu.voxels.weight_gradient(*tables[:2], rows, raw, rgb, grad_weights)
            if lanes:
                cpu.voxels.add_sh_weight_gradient(tables[2], rows, basis, rgb, grad_weights, lanes)
        return density, color, sh_coefficients, None, grad_weights, None


def interpolate_voxels_reference(
    density: Tensor, color: Tensor, sh_coefficients: Tensor, rows: Tensor, weights: Tensor, basis: Tensor
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """`interpolate_voxels` in plain PyTorch, for every device and differentiable in weights and basis too."""
    # Concatenated for a single gather.
    corner_values = interpolate_rows(torch.cat([density[:, None], color, sh_coefficients], dim=1), rows, weights)
    raw, rgb, mixed = corner_values.split([1, 3, sh_coefficients.shape[1]], dim=1)
    return raw[:, 0], rgb + (mixed.unflatten(1, (3, -1)) * basis[:, None]).sum(2)


def interpolate_voxels(
    density: Float[Tensor, "V"],
    color: Float[Tensor, "V 3"],
    sh_coefficients: Float[Tensor, "V C"],
    rows: Int[Tensor, "N 8"],
    weights: Float[Tensor, "N 8"],
    basis: Float[Tensor, "N B"],
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Interpolates density and view-dependent color.

    Args:
        density, color: values per row.
        sh_coefficients: C = 3 B coefficients of the color's view-dependent part, red first.
        rows, weights: output of `locate_vertices`.
        basis: basis functions at each sample's direction, without gradient.
    """
    if has_fast_kernel(density, color, sh_coefficients, weights, constants=(basis,)):
        return _InterpolateVoxels.apply(density, color, sh_coefficients, rows, weights, basis)
    return interpolate_voxels_reference(density, color, sh_coefficients, rows, weights, basis)


class _TotalVariation(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, vertex_of_row: Tensor, index: Tensor, first: int, last: int) -> Tensor:
        slope, sums = torch.empty(last - first), np.zeros(cpu.jit.sync_num_threads())
        cpu.voxels.total_variation(values, vertex_of_row, index, grid_side(index), first, slope, sums)
        ctx.slope, ctx.run, ctx.rows = slope, slice(first, last), len(values)
        return torch.tensor(sums.sum() / (last - first), dtype=torch.float32)

    @staticmethod
    def backward(ctx, grad_output: Tensor) -> tuple[Tensor, None, None, None, None]:
        grad = torch.zeros(ctx.rows)
        torch.mul(ctx.slope, 2 * grad_output / len(ctx.slope), out=grad[ctx.run])
        return grad, None, None, None, None


@cache_constants
def _neighbors(side: int, device: torch.device) -> tuple[Int[Tensor, "6 1"], ...]:
    """For the six neighbors: stride of the axis, signed stride, and the coordinate without that neighbor."""
    strides = torch.tensor([side * side, side, 1], device=device).repeat(2)[:, None]
    signs = torch.tensor([-1, 1], device=device).repeat_interleave(3)[:, None]
    return strides, strides * signs, (signs > 0) * (side - 1)


def total_variation_reference(
    values: Tensor, vertex_of_row: Tensor, index: Tensor, first: int, last: int
) -> Float[Tensor, ""]:
    """`total_variation` in plain PyTorch, for every device."""
    side, at = grid_side(index), vertex_of_row[first:last].long()
    strides, signed_strides, ends = _neighbors(side, index.device)
    exists = at // strides % side != ends
    # Row 0 also stands for missing neighbors.
    neighbors = index.index_select(0, (at + signed_strides * exists).flatten()).view(exists.shape) * exists
    differences = values[first:last] - values.detach().index_select(0, neighbors.flatten()).view(exists.shape)
    return (differences.square() * (neighbors > 0)).sum() / (last - first)


def total_variation(
    values: Float[Tensor, "V"], vertex_of_row: Int[Tensor, "V"], index: Int[Tensor, "cells"], first: int, last: int
) -> Float[Tensor, ""]:
    """Total variation, mean over rows `first` to `last`: squared differences to the six neighbors that are not pruned.

    Neighbors are detached, so that the gradients of consecutive slices sum to the gradient of the whole table.

    Args:
        values: value per row; row 0 is shared by pruned vertices.
        vertex_of_row: vertex index of each row; that of row 0 is ignored.
        index: see `locate_vertices`.
    """
    version = _TotalVariation.apply if has_fast_kernel(values) else total_variation_reference
    return version(values, vertex_of_row, index, first, last)
