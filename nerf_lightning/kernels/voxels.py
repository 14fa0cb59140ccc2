"""Trilinear interpolation on a sparse grid: an index over all vertices gives the row of each one that holds values.

Row 0 stands for all other vertices: its values are constants and get no gradient.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.constants import constant
from nerf_lightning.kernels.switch import has_fast


def side_of(index: Int[Tensor, "cells"]) -> int:
    """Vertices along each side of a cubic grid."""
    return round(len(index) ** (1 / 3))


@constant
def _steps(side: int, device: torch.device) -> tuple[Int[Tensor, "3"], Int[Tensor, "8"]]:
    """What a step along each axis adds to a vertex's number, and what each corner of a cell adds."""
    ends = torch.arange(2, device=device)
    corners = (ends[:, None, None] * side + ends[:, None]) * side + ends
    return torch.tensor([side * side, side, 1], device=device), corners.flatten()


def locate_reference(
    index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
    """`locate` in plain PyTorch, for every device and differentiable in the positions."""
    side = side_of(index)
    strides, corners = _steps(side, unit.device)
    scaled = unit.clamp(0, 1) * (side - 1)
    cell = scaled.long().clamp_(0, side - 2)  # NaN becomes the smallest integer
    fraction = scaled - cell
    x, y, z = torch.stack([1 - fraction, fraction], dim=2).unbind(1)
    weights = (x[:, :, None] * y[:, None])[..., None] * z[:, None, None]
    vertices = (cell * strides).sum(1, keepdim=True) + corners
    return index.index_select(0, vertices.flatten()).view(-1, 8), weights.flatten(1)


class _Locate(torch.autograd.Function):
    @staticmethod
    def forward(ctx, index: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
        places, cells = unit.T.contiguous(), side_of(index) - 1
        rows, weights = torch.empty(len(unit), 8, dtype=torch.int32), torch.empty(len(unit), 8)
        cpu.voxels.locate(index, cells, places, rows, weights)
        ctx.save_for_backward(places)
        ctx.cells = cells
        ctx.mark_non_differentiable(rows)
        return rows, weights

    @staticmethod
    def backward(ctx, _: Tensor, above: Tensor) -> tuple[None, Tensor]:
        (places,) = ctx.saved_tensors
        grad = torch.empty_like(places)
        cpu.voxels.slope(ctx.cells, places, above, grad)
        return None, grad.T


def locate(index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
    """Rows and trilinear weights of the eight vertices around each position, the last axis fastest.

    Args:
        index: row of every vertex of a cubic grid over the unit cube, 32-bit, last axis fastest.
        unit: positions in [0, 1]^3; outside they are clamped.
    """
    return _Locate.apply(index, unit) if has_fast(unit) else locate_reference(index, unit)


def mark_rows(seen: Int[Tensor, "V"], rows: Int[Tensor, "N 8"], step: int) -> None:
    """Writes `step` into `seen` at the rows that were read; both tensors are 32-bit."""
    if not has_fast(seen):
        seen.index_fill_(0, rows.flatten().long(), step)
    else:
        cpu.voxels.mark(seen, rows, step)


def interpolate_rows(
    values: Float[Tensor, "V *F"], rows: Int[Tensor, "N 8"], weights: Float[Tensor, "N 8"]
) -> Float[Tensor, "N *F"]:
    """Interpolates any number of values per vertex, in plain PyTorch."""
    values = torch.cat([values[:1].detach(), values[1:]])
    found = values.index_select(0, rows.flatten()).view(*rows.shape, *values.shape[1:])
    return (found * weights.view(*weights.shape, *[1] * (values.dim() - 1))).sum(1)


def voxel_value(
    values: Float[Tensor, "V"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N"]:
    """Interpolates one value per vertex at positions in [0, 1]^3; fast without gradients, as samplers call it."""
    if not has_fast(values, unit, constants=(values, unit) if torch.is_grad_enabled() else ()):
        return interpolate_rows(values, *locate_reference(index, unit))
    out = torch.empty(len(unit))
    cpu.voxels.interpolate(values, index, side_of(index) - 1, unit.T, out)
    return out


class _Read(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx, density: Tensor, colour: Tensor, views: Tensor, rows: Tensor, weights: Tensor, basis: Tensor
    ) -> tuple[Tensor, Tensor]:
        raw, rgb, basis = torch.empty(len(rows)), torch.empty(3, len(rows)), basis.T.contiguous()
        cpu.voxels.read(density, colour, rows, weights, raw, rgb)
        if len(basis):
            cpu.voxels.add_views(views, rows, weights, basis, rgb, (0,) * len(basis))
        ctx.save_for_backward(density, colour, views, rows, weights, basis)
        return raw, rgb.T

    @staticmethod
    def backward(ctx, raw: Tensor, rgb: Tensor) -> tuple[Tensor, Tensor, Tensor, None, Tensor | None, None]:
        *tables, rows, weights, basis = ctx.saved_tensors
        rgb, moved, lanes = rgb.T.contiguous(), None, (0,) * len(basis)
        density, colour, views = (torch.zeros(table.shape) for table in tables)
        cpu.voxels.scatter(density, colour, rows, weights, raw, rgb)
        if lanes:
            cpu.voxels.scatter_views(views, rows, weights, basis, rgb, lanes)
        if ctx.needs_input_grad[4]:
            moved = torch.empty(weights.shape)
            cpu.voxels.pull(*tables[:2], rows, raw, rgb, moved)
            if lanes:
                cpu.voxels.pull_views(tables[2], rows, basis, rgb, moved, lanes)
        return density, colour, views, None, moved, None


def read_voxels_reference(
    density: Tensor, colour: Tensor, views: Tensor, rows: Tensor, weights: Tensor, basis: Tensor
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """`read_voxels` in plain PyTorch, for every device and differentiable in weights and basis too."""
    # One table: a single gather.
    found = interpolate_rows(torch.cat([density[:, None], colour, views], dim=1), rows, weights)
    raw, rgb, mixed = found.split([1, 3, views.shape[1]], dim=1)
    return raw[:, 0], rgb + (mixed.unflatten(1, (3, -1)) * basis[:, None]).sum(2)


def read_voxels(
    density: Float[Tensor, "V"],
    colour: Float[Tensor, "V 3"],
    views: Float[Tensor, "V C"],
    rows: Int[Tensor, "N 8"],
    weights: Float[Tensor, "N 8"],
    basis: Float[Tensor, "N B"],
) -> tuple[Float[Tensor, "N"], Float[Tensor, "N 3"]]:
    """Interpolates one density per vertex, and a colour that depends on the direction.

    Args:
        density, colour: of the vertices that are kept.
        views: C = 3 B coefficients of the colour's view-dependent part, red's first.
        rows, weights: of the vertices around each sample, as `locate` gives them.
        basis: the basis functions at each sample's direction, constants.
    """
    if has_fast(density, colour, views, weights, constants=(basis,)):
        return _Read.apply(density, colour, views, rows, weights, basis)
    return read_voxels_reference(density, colour, views, rows, weights, basis)


class _Roughness(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, vertex: Tensor, index: Tensor, first: int, last: int) -> Tensor:
        slope, sums = torch.empty(last - first), np.zeros(cpu.compile.workers())
        cpu.voxels.roughness(values, vertex, index, side_of(index), first, slope, sums)
        ctx.slope, ctx.run, ctx.rows = slope, slice(first, last), len(values)
        return torch.tensor(sums.sum() / (last - first), dtype=torch.float32)

    @staticmethod
    def backward(ctx, above: Tensor) -> tuple[Tensor, None, None, None, None]:
        grad = torch.zeros(ctx.rows)
        torch.mul(ctx.slope, 2 * above / len(ctx.slope), out=grad[ctx.run])
        return grad, None, None, None, None


@constant
def _neighbours(side: int, device: torch.device) -> tuple[Int[Tensor, "6 1"], ...]:
    """For the six directions: the axis's stride, the step to the neighbour, and the coordinate that has no neighbour there."""
    strides = torch.tensor([side * side, side, 1], device=device).repeat(2)[:, None]
    signs = torch.tensor([-1, 1], device=device).repeat_interleave(3)[:, None]
    return strides, strides * signs, (signs > 0) * (side - 1)


def roughness_reference(values: Tensor, vertex: Tensor, index: Tensor, first: int, last: int) -> Float[Tensor, ""]:
    """`roughness` in plain PyTorch, for every device."""
    side, at = side_of(index), vertex[first:last].long()
    strides, ways, ends = _neighbours(side, index.device)
    inside = at // strides % side != ends
    # Row 0 stands for all that are not kept, and is used where there is no neighbour.
    other = index.index_select(0, (at + ways * inside).flatten()).view(inside.shape) * inside
    apart = values[first:last] - values.detach().index_select(0, other.flatten()).view(inside.shape)
    return (apart.square() * (other > 0)).sum() / (last - first)


def roughness(
    values: Float[Tensor, "V"], vertex: Int[Tensor, "V"], index: Int[Tensor, "cells"], first: int, last: int
) -> Float[Tensor, ""]:
    """Mean over rows `first` to `last` of the sum of squared differences to those of the six neighbours that are kept.

    Neighbours count as constants, so that the gradients of consecutive runs of rows add up to that of the whole table.

    Args:
        values: of the kept vertices; row 0 is that of all others.
        vertex: number of each row's vertex in the grid; row 0's is not read.
        index: see `locate`.
    """
    version = _Roughness.apply if has_fast(values) else roughness_reference
    return version(values, vertex, index, first, last)
