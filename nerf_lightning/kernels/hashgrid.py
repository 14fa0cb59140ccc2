"""Trilinear interpolation on nested grids with hashed entries (Instant-NGP, Müller et al. 2022, section 3)."""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels.switch import fast

# Instant-NGP, eq. 4: pi_1 = 1, pi_2 = 2654435761, pi_3 = 805459861; the second as the int32 it wraps to.
PRIMES = (1, 2654435761 - 2**32, 805459861)


def corners(
    cell: Int[Tensor, "3 N"], fraction: Float[Tensor, "3 N"], resolution: int, entries: int
) -> tuple[Int[Tensor, "8 N"], Float[Tensor, "8 N"]]:
    """Table entry and trilinear weight of the eight corners of each position's cell.

    Entries are row-major where all corners of the grid fit in `entries` (a power of two if they do not), else hashed.

    Args:
        cell: lower corner, in [0, resolution).
        fraction: position within the cell, in [0, 1].
        resolution: cells along each side of the grid.
        entries: size of the table.
    """
    side = resolution + 1
    dense = side**3 <= entries
    factors = (1, side, side * side) if dense else PRIMES
    # A product an axis and side, which the corners then combine. Positions run last: long, contiguous vector operations.
    low = [cell[axis] * factor for axis, factor in enumerate(factors)]
    ends = [(a, a + factor) for a, factor in zip(low, factors, strict=True)]
    shares = [(1 - f, f) for f in fraction]
    index, weight = [], []
    for i in (0, 1):
        for j in (0, 1):
            x, y = ends[0][i], ends[1][j]
            both, share = (x + y if dense else x ^ y), shares[0][i] * shares[1][j]
            for k in (0, 1):
                index.append(both + ends[2][k] if dense else (both ^ ends[2][k]) & (entries - 1))
                weight.append(share * shares[2][k])
    return torch.stack(index), torch.stack(weight)


def hash_interpolate_reference(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N 3"], resolutions: list[int], sizes: list[int]
) -> Float[Tensor, "N LF"]:
    """`hash_interpolate` in plain torch, for every device and differentiable in the positions too."""
    places = unit.clamp(0, 1).T.contiguous()
    indices, weights, start = [], [], 0
    for resolution, size in zip(resolutions, sizes, strict=True):
        scaled = places * resolution
        cell = scaled.to(torch.int32).clamp_(0, resolution - 1)  # what is not a number stays so, in some cell
        index, weight = corners(cell, scaled - cell, resolution, size)
        # int64, for which alone the CPU's index_add (the gather's gradient) is fast: 7 against 105 ms for two million.
        indices.append(index.long() + start)
        weights.append(weight)
        start += size
    # One gather for all levels: each gather's gradient is as large as the whole of `tables`.
    index = torch.stack(indices)
    entries = tables.index_select(0, index.flatten()).view(*index.shape, tables.shape[1])
    return (entries * torch.stack(weights)[..., None]).sum(1).transpose(0, 1).flatten(1)


class HashInterpolate(torch.autograd.Function):
    """The fast version, in two or three dimensions."""

    @staticmethod
    def forward(ctx, tables: Tensor, unit: Tensor, resolutions: list, sizes: list[int]) -> Tensor:
        from nerf_lightning.kernels.cpu import hashgrid, hashgrid2d, workers

        kernels = ctx.kernels = hashgrid if unit.shape[1] == 3 else hashgrid2d
        places = unit.T.contiguous()
        ctx.save_for_backward(places)
        ctx.levels = np.array(resolutions, np.int32), np.array(sizes, np.int64)
        ctx.shape = tuple(tables.shape)
        features = (0,) * tables.shape[1]
        out = torch.empty(len(sizes) * tables.shape[1], len(unit))
        kernels.interpolate(tables.detach().numpy(), places.numpy(), *ctx.levels, out.numpy(), features, workers())
        return out.T

    @staticmethod
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None, None, None]:
        from nerf_lightning.kernels.cpu import workers

        (places,) = ctx.saved_tensors
        tables = torch.empty(ctx.shape)
        above, features = grad.T.contiguous().numpy(), (0,) * ctx.shape[1]
        ctx.kernels.scatter(tables.numpy(), places.numpy(), *ctx.levels, above, features, workers())
        return tables, None, None, None


def hash_interpolate(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N 3"], resolutions: list[int], sizes: list[int]
) -> Float[Tensor, "N LF"]:
    """Trilinear interpolation at every level, features side by side.

    Args:
        tables: the levels' entries, one level after the other.
        unit: positions in [0, 1]^3; outside they are clamped.
        resolutions: cells along each side, a level.
        sizes: entries of each level's table: all corners of its grid, or a power of two to hash into.
    """
    if fast(tables, unit) and not unit.requires_grad:
        return HashInterpolate.apply(tables, unit, resolutions, sizes)
    return hash_interpolate_reference(tables, unit, resolutions, sizes)
