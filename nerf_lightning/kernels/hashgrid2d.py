"""Bilinear interpolation on nested grids with hashed entries: `hashgrid` in two dimensions (Instant-NGP, section 3)."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels.hashgrid import PRIMES, HashInterpolate
from nerf_lightning.kernels.switch import fast

Resolution = tuple[int, int]
"""Cells of a level along x and along y."""


def corners_2d(
    cell: Int[Tensor, "2 N"], fraction: Float[Tensor, "2 N"], resolution: Resolution, entries: int
) -> tuple[Int[Tensor, "4 N"], Float[Tensor, "4 N"]]:
    """Table entry and bilinear weight of the four corners of each place's cell, y fastest.

    Entries are row-major where all corners of the grid fit in `entries` (a power of two if they do not), else hashed.

    Args:
        cell: lower corner, in [0, resolution).
        fraction: place within the cell, in [0, 1].
        resolution: cells of the grid along x and y.
        entries: size of the table.
    """
    side = resolution[0] + 1
    dense = side * (resolution[1] + 1) <= entries
    index, weight = [], []
    for i in (0, 1):
        for j in (0, 1):
            x, y = cell[0] + i, cell[1] + j
            index.append(x + y * side if dense else (x ^ (y * PRIMES[1])) & (entries - 1))
            weight.append((fraction[0] if i else 1 - fraction[0]) * (fraction[1] if j else 1 - fraction[1]))
    return torch.stack(index), torch.stack(weight)


def hash_interpolate_2d_reference(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N 2"], resolutions: list[Resolution], sizes: list[int]
) -> Float[Tensor, "N LF"]:
    """`hash_interpolate_2d` in plain torch, for every device and differentiable in the places too."""
    places = unit.clamp(0, 1).T.contiguous()
    out, start = [], 0
    for resolution, size in zip(resolutions, sizes, strict=True):
        cells = torch.tensor(resolution, device=unit.device)[:, None]
        scaled = places * cells
        cell = scaled.to(torch.int32).clamp_(min=0).minimum(cells.int() - 1)  # what is not a number stays so
        index, weight = corners_2d(cell, scaled - cell, resolution, size)
        # int64, for which alone the CPU's index_add (the gather's gradient) is fast.
        entries = tables.index_select(0, index.flatten().long() + start).view(*index.shape, tables.shape[1])
        out.append((entries * weight[..., None]).sum(0))
        start += size
    return torch.cat(out, dim=1)


def hash_interpolate_2d(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N 2"], resolutions: list[Resolution], sizes: list[int]
) -> Float[Tensor, "N LF"]:
    """Bilinear interpolation at every level, features side by side.

    Args:
        tables: the levels' entries, one level after the other.
        unit: places in [0, 1]^2; outside they are clamped.
        resolutions: cells along x and y, a level.
        sizes: entries of each level's table: all corners of its grid, or a power of two to hash into.
    """
    if fast(tables, unit) and not unit.requires_grad:
        return HashInterpolate.apply(tables, unit, resolutions, sizes)
    return hash_interpolate_2d_reference(tables, unit, resolutions, sizes)
