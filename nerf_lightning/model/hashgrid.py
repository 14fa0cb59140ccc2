"""Multiresolution hash grid (Instant-NGP, Müller et al. 2022) and the field that reads from it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import hash_interpolate, mlp, mlp_heads
from nerf_lightning.kernels.hashgrid import Cells, corner_count, entry_of
from nerf_lightning.model.field import Field, FieldOutput, Size
from nerf_lightning.model.layers.activation import Activation, density_activation
from nerf_lightning.model.layers.encoding import encode_directions, num_sh_bases
from nerf_lightning.model.layers.networks import layers, linears, weights, widen
from nerf_lightning.model.layers.pruning import vertices_in
from nerf_lightning.utils.options import Count, Entries, Layers, SHDegree, Side


def level_resolutions(levels: int, coarsest: int, finest: int) -> list[int]:
    """Cells along each side of every level, growing geometrically from coarsest to finest (Instant-NGP, eq. 2 and 3).

    Raises:
        InputError: where coarsest > finest.
    """
    if coarsest > finest:
        raise InputError("model.coarsest", "", f"{coarsest} with model.finest={finest}", "0 < coarsest <= finest")
    growth = (finest / coarsest) ** (1 / max(levels - 1, 1))
    return [round(coarsest * growth**level) for level in range(levels)]


def cubic_cells(levels: int, coarsest: int, finest: int) -> list[Cells]:
    """Cells along each axis of every level of a grid of cubes, see `level_resolutions`."""
    return [(side,) * 3 for side in level_resolutions(levels, coarsest, finest)]


def table_sizes(cells: Sequence[Cells], entries: int) -> list[int]:
    """Entries of each level's table: all corners of its grid where they fit."""
    return [min(corner_count(level), entries) for level in cells]


class HashGrid(torch.nn.Module):
    """Trainable features on nested grids over the unit square or cube.

    Args:
        cells: of each grid along each axis.
        log2_entries: each level has at most 2^log2_entries entries; levels too fine for that share them by hashing.
        features: numbers per entry.
    """

    def __init__(self, cells: Sequence[Cells], log2_entries: int, features: int):
        super().__init__()
        self.cells = list(cells)
        self.sizes = table_sizes(self.cells, 2**log2_entries)
        self.tables = torch.nn.Parameter(torch.empty(sum(self.sizes), features).uniform_(-1e-4, 1e-4))
        self.width = len(self.cells) * features

    def forward(self, unit: Float[Tensor, "N D"]) -> Float[Tensor, "N LF"]:
        return hash_interpolate(self.tables, unit, self.cells, self.sizes)

    def rows(self, vertices: Int[Tensor, "D N"], level: int) -> Int[Tensor, "N"]:
        """Rows of `tables` that hold a level's vertices."""
        return sum(self.sizes[:level]) + entry_of(vertices, self.cells[level], self.sizes[level])

    @torch.no_grad()
    def warm_start_from(self, smaller: "HashGrid") -> Int[Tensor, "I"] | None:
        """Copies the levels of another grid; this one's tables are as large or larger.

        Returns:
            For each feature of the smaller grid, its place among this grid's; None, and nothing is copied, without all levels.
        """
        features = self.tables.shape[1]
        if features != smaller.tables.shape[1] or any(cells not in self.cells for cells in smaller.cells):
            return None
        levels = [self.cells.index(cells) for cells in smaller.cells]
        for its, mine in enumerate(levels):
            cells, size = self.cells[mine], self.sizes[mine]
            if size == corner_count(cells):
                vertices = torch.cartesian_prod(*(torch.arange(side + 1, dtype=torch.int32) for side in cells)).T
                self.tables[self.rows(vertices, mine)] = smaller.tables[smaller.rows(vertices, its)]
            else:  # hashes differ only in how many of their bits are used
                entries = sum(smaller.sizes[:its]) + torch.arange(size) % smaller.sizes[its]
                self.tables[sum(self.sizes[:mine]) + torch.arange(size)] = smaller.tables[entries]
        return (features * torch.tensor(levels)[:, None] + torch.arange(features)).flatten()

    @torch.no_grad()
    def prune(self, reached: Bool[Tensor, "G G G"]) -> None:
        """Zeroes the entries that no position in the reached cells reads."""
        read = torch.zeros(len(self.tables), dtype=torch.bool, device=reached.device)
        for level, (side, *_) in enumerate(self.cells):
            read[self.rows(vertices_in(reached, side).nonzero().T.int(), level)] = True
        self.tables[~read] = 0


class HashGridField(Field):
    """Hash-grid features, a small density network, and a small colour network that also sees the direction.

    Args:
        bounds: the box the grid covers.
        levels: number of grids.
        log2_entries, features: see `HashGrid`.
        coarsest, finest: cells along a side of the first and the last grid.
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
        cells = cubic_cells(levels, *self.grid_sizes(coarsest, finest, size))
        self.grid = HashGrid(cells, log2_entries, features)
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

    def warm_start_from(self, smaller: Field) -> None:
        """Copies a field that has no other levels, and makes colours alike."""
        assert isinstance(smaller, HashGridField)
        if self.split_colour != smaller.split_colour or (columns := self.grid.warm_start_from(smaller.grid)) is None:
            return
        widen(linears(self.density_net), linears(smaller.density_net), columns)
        widen(linears(self.colour_net), linears(smaller.colour_net))

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
