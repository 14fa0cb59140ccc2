"""Multiresolution hash grid (Instant-NGP, Müller et al. 2022) and the field that reads from it."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.model.activation import density_activation
from nerf_lightning.model.encoding import spherical_harmonics
from nerf_lightning.model.field import Field

# Instant-NGP, eq. 4: pi_1 = 1, pi_2 = 2654435761, pi_3 = 805459861; the second as the int32 it wraps to.
PRIMES = (1, 2654435761 - 2**32, 805459861)


def level_resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Cells along each side of every level, growing geometrically from coarsest to finest (Instant-NGP, eq. 2 and 3)."""
    growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
    return [round(coarsest * growth**level) for level in range(levels)]


def corner_index(cell: Int[Tensor, "N 3"], resolution: int, entries: int) -> Int[Tensor, "N 8"]:
    """Table entry of each corner of a cell: row-major where all corners fit in `entries` (a power of two), else hashed."""
    side = resolution + 1
    dense = side**3 <= entries
    factors = (1, side, side * side) if dense else PRIMES
    # One product an axis and side; the eight corners then only combine them.
    scaled = [torch.stack([cell[:, a] * f, (cell[:, a] + 1) * f], dim=1) for a, f in enumerate(factors)]
    x, y, z = scaled[0][:, :, None, None], scaled[1][:, None, :, None], scaled[2][:, None, None, :]
    index = x + y + z if dense else (x ^ y ^ z) & (entries - 1)
    return index.flatten(1)


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
    unit = unit.clamp(0, 1)
    indices, weights, start = [], [], 0
    for resolution, size in zip(resolutions, sizes, strict=True):
        scaled = unit * resolution
        cell = scaled.to(torch.int32).clamp_(max=resolution - 1)
        w = torch.stack([1 - (scaled - cell), scaled - cell], dim=1)
        weights.append((w[:, :, None, None, 0] * w[:, None, :, None, 1] * w[:, None, None, :, 2]).flatten(1))
        indices.append(corner_index(cell, resolution, size) + start)
        start += size
    # One gather for all levels: each gather's gradient is as large as the whole of `tables`.
    index = torch.stack(indices, dim=1)
    corners = tables.index_select(0, index.flatten()).view(*index.shape, -1)
    return (corners * torch.stack(weights, dim=1)[..., None]).sum(2).flatten(1)


class HashGrid(torch.nn.Module):
    """Trainable features on nested grids over the unit cube.

    Args:
        levels: how many grids.
        log2_entries: each level keeps at most 2^log2_entries entries; finer levels than fit share them by hashing.
        features: numbers an entry.
        coarsest, finest: cells along a side of the first and the last level.
    """

    def __init__(self, levels: int = 8, log2_entries: int = 16, features: int = 2, coarsest: int = 16, finest: int = 256):
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
        levels: int = 8,
        log2_entries: int = 16,
        features: int = 2,
        coarsest: int = 16,
        finest: int = 256,
        width: int = 32,
        density: str = "exp",
    ):
        super().__init__(bounds)
        self.grid = HashGrid(levels, log2_entries, features, coarsest, finest)
        self.activation = density_activation(density)
        nn = torch.nn
        self.density_net = nn.Sequential(nn.Linear(self.grid.width, width), nn.ReLU(), nn.Linear(width, 1 + self.GEOMETRY))
        self.colour_net = nn.Sequential(
            nn.Linear(16 + self.GEOMETRY, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 3)
        )

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        out = self.density_net(self.grid(self.bounds.to_unit(positions)))
        return self.activation(out[:, 0]), out[:, 1:]

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        return torch.sigmoid(self.colour_net(torch.cat([spherical_harmonics(directions), features], dim=1)))
