"""Trilinear interpolation on a sparse grid: an index over all vertices gives the row of each one that holds values.

Row 0 stands for all other vertices: its values are constants and get no gradient.
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
    """What a step along each axis adds to a vertex's number, and what each corner of a cell adds."""
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
        places, cells = unit.T.contiguous(), grid_side(index) - 1
        rows, weights = torch.empty(len(unit), 8, dtype=torch.int32), torch.empty(len(unit), 8)
        cpu.voxels.locate_vertices(index, cells, places, rows, weights)
        ctx.save_for_backward(places)
        ctx.cells = cells
        ctx.mark_non_differentiable(rows)
        return rows, weights

    @staticmethod
    def backward(ctx, _: Tensor, grad_output: Tensor) -> tuple[None, Tensor]:
        (places,) = ctx.saved_tensors
        grad = torch.empty_like(places)
        cpu.voxels.position_gradient(ctx.cells, places, grad_output, grad)
        return None, grad.T


def locate_vertices(
    index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
    """Rows and trilinear weights of the eight vertices around each position, the last axis fastest.

    Args:
        index: row of every vertex of a cubic grid over the unit cube, 32-bit, last axis fastest.
        unit: positions in [0, 1]^3; outside they are clamped.
    """
    return _LocateVertices.apply(index, unit) if has_fast_kernel(unit) else locate_vertices_reference(index, unit)


def mark_rows(last_read_step: Int[Tensor, "V"], rows: Int[Tensor, "N 8"], step: int) -> None:
    """Writes `step` into `last_read_step` at the rows that were read; both tensors are 32-bit."""
    if not has_fast_kernel(last_read_step):
        last_read_step.index_fill_(0, rows.flatten().long(), step)
    else:
        cpu.voxels.mark_rows(last_read_step, rows, step)


def interpolate_rows(
    values: Float[Tensor, "V *F"], rows: Int[Tensor, "N 8"], weights: Float[Tensor, "N 8"]
) -> Float[Tensor, "N *F"]:
    """Interpolates any number of values per vertex, in plain PyTorch."""
    values = torch.cat([values[:1].detach(), values[1:]])
    found = values.index_select(0, rows.flatten()).view(*rows.shape, *values.shape[1:])
    return (found * weights.view(*weights.shape, *[1] * (values.dim() - 1))).sum(1)


def interpolate_scalar(
    values: Float[Tensor, "V"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N"]:
    """Interpolates one value per vertex at positions in [0, 1]^3; fast without gradients, as samplers call it."""
    if not has_fast_kernel(values, unit, constants=(values, unit) if torch.is_grad_enabled() else ()):
        return interpolate_rows(values, *locate_vertices_reference(index, unit))
    out = torch.empty(len(unit))
    cpu.voxels.interpolate(values, index, grid_side(index) - 1, unit.T, out)
    return out


class _InterpolateVoxels(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, density: Tensor, colour: Tensor, sh_coefficients: Tensor, rows: Tensor, weights: Tensor, basis: Tensor
    ) -> tuple[Tensor, Tensor]:
        raw, rgb, basis = torch.empty(len(rows)), torch.empty(3, len(rows)), basis.T.contiguous()
        cpu.voxels.read(density, colour, rows, weights, raw, rgb)
        if len(basis):
            cpu.voxels.add_sh_colour(sh_coefficients, rows, weights, basis, rgb, (0,) * len(basis))
        ctx.save_for_backward(density, colour, sh_coefficients, rows, weights, basis)
        return raw, rgb.T

    @staticmethod
    def backward(ctx, raw: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor, None, Tensor | None, None]:
        *tables, rows, weights, basis = ctx.saved_tensors
        rgb, moved, lanes = rgb.T.contiguous(), None, (0,) * len(basis)
        density, colour, sh_coefficients = (torch.zeros(table.shape) for table in tables)
        cpu.voxels.scatter(density, colour, rows, weights, raw, rgb)
        if lanes:
            cpu.voxels.scatter_sh(sh_coefficients, rows, weights, basis, rgb, lanes)
        if ctx.needs_input_grad[4]:
            moved = torch.empty(weights.shape)
            cpu.voxels.weight_gradient(*tables[:2], rows, raw, rgb, moved)
            if lanes:
                cpu.voxels.add_sh_weight_gradient(tables[2], rows, basis, rgb, moved, lanes)
        return density, colour, sh_coefficients, None, moved, None


def interpolate_voxels_reference(
    density: Tensor, colour: Tensor, sh_coefficients: Tensor, rows: Tensor, weights: Tensor, basis: Tensor
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """`interpolate_voxels` in plain PyTorch, for every device and differentiable in weights and basis too."""
    # One table: a single gather.
    found = interpolate_rows(torch.cat([density[:, None], colour, sh_coefficients], dim=1), rows, weights)
    raw, rgb, mixed = found.split([1, 3, sh_coefficients.shape[1]], dim=1)
    return raw[:, 0], rgb + (mixed.unflatten(1, (3, -1)) * basis[:, None]).sum(2)


def interpolate_voxels(
    density: Float[Tensor, "V"],
    colour: Float[Tensor, "V 3"],
    sh_coefficients: Float[Tensor, "V C"],
    rows: Int[Tensor, "N 8"],
    weights: Float[Tensor, "N 8"],
    basis: Float[Tensor, "N B"],
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Interpolates one density per vertex, and a colour that depends on the direction.

    Args:
        density, colour: of the vertices that are kept.
        sh_coefficients: C = 3 B coefficients of the colour's view-dependent part, red's first.
        rows, weights: of the vertices around each sample, as `locate_vertices` gives them.
        basis: the basis functions at each sample's direction, constants.
    """
    if has_fast_kernel(density, colour, sh_coefficients, weights, constants=(basis,)):
        return _InterpolateVoxels.apply(density, colour, sh_coefficients, rows, weights, basis)
    return interpolate_voxels_reference(density, colour, sh_coefficients, rows, weights, basis)


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
def _neighbours(side: int, device: torch.device) -> tuple[Int[Tensor, "6 1"], ...]:
    """For the six directions: the axis's stride, the step to the neighbour, and the coordinate that has no neighbour there."""
    strides = torch.tensor([side * side, side, 1], device=device).repeat(2)[:, None]
    signs = torch.tensor([-1, 1], device=device).repeat_interleave(3)[:, None]
    return strides, strides * signs, (signs > 0) * (side - 1)


def total_variation_reference(
    values: Tensor, vertex_of_row: Tensor, index: Tensor, first: int, last: int
) -> Float[Tensor, ""]:
    """`total_variation` in plain PyTorch, for every device."""
    side, at = grid_side(index), vertex_of_row[first:last].long()
    strides, ways, ends = _neighbours(side, index.device)
    inside = at // strides % side != ends
    # Row 0 stands for all that are not kept, and is used where there is no neighbour.
    other = index.index_select(0, (at + ways * inside).flatten()).view(inside.shape) * inside
    apart = values[first:last] - values.detach().index_select(0, other.flatten()).view(inside.shape)
    return (apart.square() * (other > 0)).sum() / (last - first)


def total_variation(
    values: Float[Tensor, "V"], vertex_of_row: Int[Tensor, "V"], index: Int[Tensor, "cells"], first: int, last: int
) -> Float[Tensor, ""]:
    """Mean over rows `first` to `last` of the sum of squared differences to those of the six neighbours that are kept.

    Neighbours count as constants, so that the gradients of consecutive runs of rows add up to that of the whole table.

    Args:
        values: of the kept vertices; row 0 is that of all others.
        vertex_of_row: number of each row's vertex in the grid; row 0's is not read.
        index: see `locate_vertices`.
    """
    version = _TotalVariation.apply if has_fast_kernel(values) else total_variation_reference
    return version(values, vertex_of_row, index, first, last)
