"""Trilinear interpolation on a sparse grid: an index of all vertices says which of them hold values, and in which row.

Row 0 stands for all vertices that hold none: its values are constants and get no gradient.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.kernels.switch import fast


def side_of(index: Int[Tensor, "cells"]) -> int:
    """Vertices along each side of a cubic grid."""
    return round(len(index) ** (1 / 3))


def vertices(
    unit: Float[Tensor, "N 3"], index: Int[Tensor, "cells"]
) -> tuple[Int[Tensor, "N 8"], Float[Tensor, "N 8"]]:
    """Rows and trilinear weights of the eight vertices around each position (clamped into [0, 1]^3), last axis fastest."""
    side = side_of(index)
    scaled = unit.clamp(0, 1) * (side - 1)
    cell = scaled.long().clamp(0, side - 2)  # what is not a number becomes the smallest of all
    fraction = scaled - cell
    rows, weights = [], []
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                at = ((cell[:, 0] + i) * side + cell[:, 1] + j) * side + cell[:, 2] + k
                rows.append(index[at].long())
                shares = [f if bit else 1 - f for f, bit in zip(fraction.unbind(1), (i, j, k), strict=True)]
                weights.append(shares[0] * shares[1] * shares[2])
    return torch.stack(rows, 1), torch.stack(weights, 1)


def voxel_values_reference(
    values: Float[Tensor, "V *F"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N *F"]:
    """Values interpolated at positions in [0, 1]^3, in plain torch, for every device; any number of values a vertex."""
    rows, weights = vertices(unit, index)
    values = torch.cat([values[:1].detach(), values[1:]])
    return torch.einsum("nc,nc...->n...", weights, values[rows])


class _Value(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, index: Tensor, unit: Tensor) -> Tensor:
        from nerf_lightning.kernels.cpu import voxels, workers

        places, out = unit.T.contiguous(), torch.empty(len(unit))
        voxels.interpolate(
            values.detach().numpy(), index.numpy(), side_of(index) - 1, places.numpy(), out.numpy(), workers()
        )
        ctx.save_for_backward(index, places)
        ctx.rows = len(values)
        return out

    @staticmethod
    def backward(ctx, above: Tensor) -> tuple[Tensor, None, None]:
        from nerf_lightning.kernels.cpu import voxels, workers

        index, places = ctx.saved_tensors
        grad = torch.zeros(ctx.rows)
        arrays = index.numpy(), side_of(index) - 1, places.numpy(), above.contiguous().numpy()
        voxels.scatter(grad.numpy(), *arrays, workers())
        return grad, None, None


def voxel_value(
    values: Float[Tensor, "V"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]
) -> Float[Tensor, "N"]:
    """One value a vertex, interpolated.

    Args:
        values: of the vertices that are kept.
        index: row of every vertex of a cubic grid over the unit cube, last axis fastest.
        unit: positions in [0, 1]^3; outside they are clamped.
    """
    if fast(values, unit) and not unit.requires_grad:
        return _Value.apply(values, index, unit)
    return voxel_values_reference(values, index, unit)


class _Colour(torch.autograd.Function):
    @staticmethod
    def forward(ctx, values: Tensor, index: Tensor, unit: Tensor, basis: Tensor) -> Tensor:
        from nerf_lightning.kernels.cpu import voxels, workers

        places, basis, out = unit.T.contiguous(), basis.T.contiguous(), torch.empty(3, len(unit))
        arrays = values.detach().numpy(), index.numpy(), side_of(index) - 1, places.numpy(), basis.numpy()
        voxels.interpolate_colour(*arrays, out.numpy(), workers())
        ctx.save_for_backward(index, places, basis)
        ctx.shape = tuple(values.shape)
        return out.T

    @staticmethod
    def backward(ctx, above: Tensor) -> tuple[Tensor, None, None, None]:
        from nerf_lightning.kernels.cpu import voxels, workers

        index, places, basis = ctx.saved_tensors
        grad = torch.zeros(ctx.shape)
        arrays = index.numpy(), side_of(index) - 1, places.numpy(), basis.numpy(), above.T.contiguous().numpy()
        voxels.scatter_colour(grad.numpy(), *arrays, workers())
        return grad, None, None, None


def voxel_colour_reference(
    values: Float[Tensor, "V C"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"], basis: Float[Tensor, "N B"]
) -> Float[Tensor, "N 3"]:
    """`voxel_colour` in plain torch, for every device."""
    mixed = voxel_values_reference(values, index, unit).view(len(unit), 3, -1)
    return torch.einsum("ncb,nb->nc", mixed, basis)


def voxel_colour(
    values: Float[Tensor, "V C"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"], basis: Float[Tensor, "N B"]
) -> Float[Tensor, "N 3"]:
    """Coefficients interpolated and summed over a basis of directions, without ever storing them a sample.

    Args:
        values: C = 3 B coefficients a vertex, those of red first.
        index, unit: see `voxel_value`.
        basis: the basis functions at each sample's direction, constants.
    """
    if fast(values, unit, basis) and not (unit.requires_grad or basis.requires_grad):
        return _Colour.apply(values, index, unit, basis)
    return voxel_colour_reference(values, index, unit, basis)


def touch_rows(touched: Bool[Tensor, "V"], index: Int[Tensor, "cells"], unit: Float[Tensor, "N 3"]) -> None:
    """Marks the rows that interpolation at these positions reads."""
    if not fast(unit):
        touched[vertices(unit, index)[0].flatten()] = True
        return
    from nerf_lightning.kernels.cpu import voxels, workers

    places = unit.detach().T.contiguous().numpy()
    voxels.touch(touched.numpy(), index.numpy(), side_of(index) - 1, places, workers())
