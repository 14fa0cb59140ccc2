"""Multiresolution hash grid (Instant-NGP, Müller et al. 2022) and the field that reads from it."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import hash_interpolate, mlp, mlp_heads
from nerf_lightning.kernels.hashgrid import Cells, corner_count, entry_of
from nerf_lightning.model.field import Field, FieldOutput, Size
from nerf_lightning.model.layers.activation import Activation, density_activation
from nerf_lightning.model.layers.pruning import vertices_in
from nerf_lightning.model.layers.view_dependence import encode_directions, num_sh_bases
from nerf_lightning.model.layers.widening import widen_all
from nerf_lightning.utils.options import Count, Entries, Layers, SHDegree, Side


def level_resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Cells along each side of every level, growing geometrically from coarsest to finest (Instant-NGP, eq. 2 and 3)."""
    growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
    return [round(coarsest * growth**level) for level in range(levels)]


def table_sizes(cells: Sequence[Cells], entries: int) -> list[int]:
    """Entries of each level's table: all corners of its grid where they fit."""
    return [min(corner_count(level), entries) for level in cells]


class HashGrid(torch.nn.Module):
    """Trainable features on nested grids over the unit cube.

    Args:
        levels: number of grids.
        log2_entries: each level has at most 2^log2_entries entries; levels too fine for that share them by hashing.
        features: numbers per entry.
        coarsest, finest: cells along a side of the first and the last level.
    """

    def __init__(
        self,
        levels: Layers = 8,
        log2_entries: Entries = 17,
        features: Count = 2,
        coarsest: Side = 16,
        finest: Side = 256,
    ):
        super().__init__()
        if not 0 < coarsest <= finest:
            raise InputError("model.coarsest", "", f"{coarsest} with model.finest={finest}", "0 < coarsest <= finest")
        self.resolutions = level_resolutions(levels, coarsest, finest)
        self.cells = [(side,) * 3 for side in self.resolutions]
        self.sizes = table_sizes(self.cells, 2**log2_entries)
        self.tables = torch.nn.Parameter(torch.empty(sum(self.sizes), features).uniform_(-1e-4, 1e-4))
        self.width = levels * features

    def forward(self, unit: Float[Tensor, "N 3"]) -> Float[Tensor, "N LF"]:
        return hash_interpolate(self.tables, unit, self.cells, self.sizes)

    def rows(self, vertices: Int[Tensor, "3 N"], level: int) -> Int[Tensor, "N"]:
        """Rows of `tables` that hold a level's vertices."""
        return sum(self.sizes[:level]) + entry_of(vertices, self.cells[level], self.sizes[level])

    @torch.no_grad()
    def warm_start_from(self, smaller: "HashGrid") -> Int[Tensor, "I"]:
        """Copies the levels whose resolutions occur here too; this grid's tables are as large or larger.

        Returns:
            For each feature of the smaller grid, its place among this grid's features, or -1 if it was not copied.
        """
        features = self.tables.shape[1]
        places = torch.full((len(smaller.sizes) * features,), -1)
        for theirs, resolution in enumerate(smaller.resolutions):
            if resolution not in self.resolutions:
                continue
            mine = self.resolutions.index(resolution)
            # Hashes differ only in how many of their bits are used: each entry of the larger table maps to one of the smaller.
            if (resolution + 1) ** 3 == self.sizes[mine]:
                vertices = torch.cartesian_prod(*[torch.arange(resolution + 1, dtype=torch.int32)] * 3).T
                rows = self.rows(vertices, mine), smaller.rows(vertices, theirs)
            else:
                entries, start = torch.arange(self.sizes[mine]), (sum(self.sizes[:mine]), sum(smaller.sizes[:theirs]))
                rows = start[0] + entries, start[1] + entries % smaller.sizes[theirs]
            self.tables[rows[0]] = smaller.tables[rows[1]]
            places[theirs * features : (theirs + 1) * features] = mine * features + torch.arange(features)
        return places

    @torch.no_grad()
    def prune(self, reached: Bool[Tensor, "G G G"]) -> None:
        """Zeroes the entries that no position in the reached cells reads."""
        read = torch.zeros(len(self.tables), dtype=torch.bool, device=reached.device)
        for level, resolution in enumerate(self.resolutions):
            read[self.rows(vertices_in(reached, resolution).nonzero().T.int(), level)] = True
        self.tables[~read] = 0


def layers(*widths: int) -> torch.nn.ModuleList:
    """Fully connected layers from each width to the next."""
    return torch.nn.ModuleList(torch.nn.Linear(i, o) for i, o in pairwise(widths))


def weights(net: torch.nn.ModuleList) -> list[tuple[Tensor, Tensor]]:
    """Matrix and bias of each of the `layers`."""
    return [(layer.get_parameter("weight"), layer.get_parameter("bias")) for layer in net]


class HashGridField(Field):
    """Hash-grid features, a small density network, and a small colour network that also sees the direction.

    Args:
        bounds: the box the grid covers.
        levels, log2_entries, features, coarsest, finest: see `HashGrid`.
        width: neurons of the hidden layers (one for density, two for colour).
        degree: see `TensoRFField`.
        split_colour: whether a place has a colour of its own, to which the colour network adds what the direction changes
            (as in SNeRG, Hedman et al. 2021); otherwise the network makes all of the colour.
        density: "relu", "softplus" or "exp".
        size: "auto" lowers `finest`, and `coarsest` with it, to what the photos can show; "fixed" takes them as they are.

    Raises:
        InputError: where coarsest > finest.
    """

    GEOMETRY = 15  # features handed from density to colour network, Instant-NGP section 5.4
    START = -1.0  # an exponential density starts as thin fog
    max_lr = 0.1

    def __init__(
        self,
        bounds: Bounds,
        levels: Layers = 8,
        log2_entries: Entries = 17,
        features: Count = 2,
        coarsest: Side = 16,
        finest: Side = 256,
        width: Count = 64,
        degree: SHDegree = 3,
        split_colour: bool = False,
        density: Activation = "exp",
        size: Size = "auto",
    ):
        super().__init__(bounds)
        self.grid = HashGrid(levels, log2_entries, features, *self.grid_sizes(coarsest, finest, size))
        self.activation = density_activation(density)
        self.density_net = layers(self.grid.width, width, 1 + self.GEOMETRY)
        self.terms = num_sh_bases(degree)
        self.split_colour = split_colour
        self.colour_net = layers(self.GEOMETRY + self.terms, width, width, 3)
        self.starts_thin = density == "exp"
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """The layers drew their own. Starting from dense fog, training may remove all density, and all gradient with it."""
        if self.starts_thin:
            self.density_net[-1].get_parameter("bias")[0] = self.START

    @torch.no_grad()
    def warm_start_from(self, smaller: Field) -> None:
        """Copies the levels that both grids have, and both networks if no level is missing here and colours are made alike."""
        assert isinstance(smaller, HashGridField)
        columns = self.grid.warm_start_from(smaller.grid)
        if (columns >= 0).all() and self.split_colour == smaller.split_colour:
            widen_all(self.density_net, smaller.density_net, columns)
            widen_all(self.colour_net, smaller.colour_net, torch.arange(self.GEOMETRY + smaller.terms))

    def prune(self, reached: Bool[Tensor, "G G G"]) -> None:
        self.grid.prune(reached)

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        encoded = self.grid(self.bounds.to_unit(positions))
        raw, geometry = mlp_heads(encoded, weights(self.density_net), 1)
        return self.activation(raw.squeeze(1)), geometry

    def forward(self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> FieldOutput:
        density, features = self.features(positions)
        logits = mlp(features, weights(self.colour_net), encode_directions(directions, self.terms))
        if not self.split_colour:
            return FieldOutput(density / self.unit_length, torch.sigmoid(logits))
        return FieldOutput(density / self.unit_length, torch.sigmoid(features[:, :3] + logits), logits)
