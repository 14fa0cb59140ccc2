"""Multiresolution hash grid (Instant-NGP, Müller et al. 2022) and the field that reads from it."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.model.activation import density_activation
from nerf_lightning.model.encoding import spherical_harmonics
from nerf_lightning.model.field import Field
from nerf_lightning.options import Count

# Instant-NGP, eq. 4: pi_1 = 1, pi_2 = 2654435761, pi_3 = 805459861; the second as the int32 it wraps to.
PRIMES = (1, 2654435761 - 2**32, 805459861)


def level_resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Cells along each side of every level, growing geometrically from coarsest to finest (Instant-NGP, eq. 2 and 3)."""
    growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
    return [round(coarsest * growth**level) for level in range(levels)]


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


def hash_interpolate(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N 3"], resolutions: list[int], sizes: list[int]
) -> Float[Tensor, "N LF"]:
    """Trilinear interpolation at every level, features side by side.

    Args:
        tables: the levels' entries, one level after the other.
        unit: positions in [0, 1]^3; outside they are clamped.
        resolutions: cells along each side, a level.
        sizes: entries of each level's table.
    """
    places = unit.clamp(0, 1).T.contiguous()
    indices, weights, start = [], [], 0
    for resolution, size in zip(resolutions, sizes, strict=True):
        scaled = places * resolution
        cell = scaled.to(torch.int32).clamp_(max=resolution - 1)
        index, weight = corners(cell, scaled - cell, resolution, size)
        # int64, for which alone the CPU's index_add (the gather's gradient) is fast: 7 against 105 ms for two million.
        indices.append(index.long() + start)
        weights.append(weight)
        start += size
    # One gather for all levels: each gather's gradient is as large as the whole of `tables`.
    index = torch.stack(indices)
    entries = tables.index_select(0, index.flatten()).view(*index.shape, tables.shape[1])
    return (entries * torch.stack(weights)[..., None]).sum(1).transpose(0, 1).flatten(1)


class HashGrid(torch.nn.Module):
    """Trainable features on nested grids over the unit cube.

    Args:
        levels: how many grids.
        log2_entries: each level keeps at most 2^log2_entries entries; finer levels than fit share them by hashing.
        features: numbers an entry.
        coarsest, finest: cells along a side of the first and the last level.
    """

    def __init__(
        self,
        levels: Count = 8,
        log2_entries: Count = 16,
        features: Count = 2,
        coarsest: Count = 16,
        finest: Count = 256,
    ):
        super().__init__()
        if not 0 < coarsest <= finest:
            raise InputError("model.coarsest", "", f"{coarsest} with model.finest={finest}", "0 < coarsest <= finest")
        self.resolutions = level_resolutions(levels, coarsest, finest)
        entries = 2**log2_entries
        # A dense level needs no more entries than corners; a hashed one takes them all.
        self.sizes = [(r + 1) ** 3 if (r + 1) ** 3 <= entries else entries for r in self.resolutions]
        self.tables = torch.nn.Parameter(torch.empty(sum(self.sizes), features).uniform_(-1e-4, 1e-4))
        self.width = levels * features

    def forward(self, unit: Float[Tensor, "N 3"]) -> Float[Tensor, "N LF"]:
        return hash_interpolate(self.tables, unit, self.resolutions, self.sizes)


class HashGridField(Field):
    """Hash-grid features, a small density network, and a small colour network that also sees the direction.

    Args:
        bounds: the box the grid covers.
        levels, log2_entries, features, coarsest, finest: the grid, see `HashGrid`.
        width: neurons of the hidden layers (one for density, two for colour).
        density: "relu", "softplus" or "exp".
    """

    GEOMETRY = 15  # features handed from density to colour network, Instant-NGP section 5.4

    def __init__(
        self,
        bounds: Bounds,
        levels: Count = 8,
        log2_entries: Count = 16,
        features: Count = 2,
        coarsest: Count = 16,
        finest: Count = 256,
        width: Count = 32,
        density: str = "exp",
    ):
        super().__init__(bounds)
        self.grid = HashGrid(levels, log2_entries, features, coarsest, finest)
        self.activation = density_activation(density)
        nn = torch.nn
        self.density_net = nn.Sequential(
            nn.Linear(self.grid.width, width), nn.ReLU(), nn.Linear(width, 1 + self.GEOMETRY)
        )
        self.colour_net = nn.Sequential(
            nn.Linear(16 + self.GEOMETRY, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 3)
        )

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        out = self.density_net(self.grid(self.bounds.to_unit(positions)))
        return self.activation(out[:, 0]), out[:, 1:]

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return torch.sigmoid(self.colour_net(torch.cat([spherical_harmonics(directions), features], dim=1)))
