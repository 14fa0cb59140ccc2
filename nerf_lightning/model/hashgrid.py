"""Multiresolution hash grid (Instant-NGP, Müller et al. 2022) and the radiance field on it."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import hash_interpolate, mlp, mlp_heads
from nerf_lightning.kernels.hashgrid import GridCells, corner_count, entry_index
from nerf_lightning.model.field import Field, FieldOutput, Size
from nerf_lightning.model.layers.activation import Activation, density_activation
from nerf_lightning.model.layers.encoding import encode_directions, num_sh_bases
from nerf_lightning.model.layers.grid_masks import vertices_of_cells
from nerf_lightning.model.layers.networks import build_layers, layer_parameters, linear_layers, widen
from nerf_lightning.utils.option_checks import Count, GridSize, Layers, Log2Size, SHDegree


def level_resolutions(num_levels: int, base_resolution: int, max_resolution: int) -> list[int]:
    """Cells along a side of every level, geometric from base to maximum resolution (Instant-NGP, eq. 2 and 3).

    Raises:
        InputError: where base_resolution > max_resolution.
    """
    if base_resolution > max_resolution:
        problem = f"{base_resolution} with model.max_resolution={max_resolution}"
        raise InputError("model.base_resolution", "", problem, "0 < base_resolution <= max_resolution")
    growth = (max_resolution / base_resolution) ** (1 / max(num_levels - 1, 1))
    return [round(base_resolution * growth**level) for level in range(num_levels)]


def cubic_cells(num_levels: int, base_resolution: int, max_resolution: int) -> list[GridCells]:
    """Cells along each axis of every level of a cubic grid, see `level_resolutions`."""
    return [(side,) * 3 for side in level_resolutions(num_levels, base_resolution, max_resolution)]


def table_sizes(cells: Sequence[GridCells], entries: int) -> list[int]:
    """Entries of each level's table: one per vertex, at most `entries`."""
    return [min(corner_count(level), entries) for level in cells]


class HashGrid(torch.nn.Module):
    """Trainable features on nested grids over the unit square or cube.

    Args:
        cells: cells of each level along each axis.
        log2_hashmap_size: log2 of a level's maximum number of entries; finer levels are hashed.
        features_per_level: features per entry.
    """

    def __init__(self, cells: Sequence[GridCells], log2_hashmap_size: int, features_per_level: int):
        super().__init__()
        self.cells = list(cells)
        self.sizes = table_sizes(self.cells, 2**log2_hashmap_size)
        self.tables = torch.nn.Parameter(torch.empty(sum(self.sizes), features_per_level).uniform_(-1e-4, 1e-4))
        self.width = len(self.cells) * features_per_level

    def forward(self, unit: Float[Tensor, "N D"]) -> Float[Tensor, "N LF"]:
        return hash_interpolate(self.tables, unit, self.cells, self.sizes)

    def rows(self, vertices: Int[Tensor, "D N"], level: int) -> Int[Tensor, "N"]:
        """Rows of `tables` for vertices of a level."""
        return sum(self.sizes[:level]) + entry_index(vertices, self.cells[level], self.sizes[level])

    @torch.no_grad()
    def warm_start_from(self, smaller: "HashGrid") -> Int[Tensor, "I"] | None:
        """Copies the levels of another grid whose tables are not larger.

        Returns:
            Index among this grid's features of each feature of the smaller grid; None (nothing copied) if a level is missing.
        """
        features = self.tables.shape[1]
        if features != smaller.tables.shape[1] or any(cells not in self.cells for cells in smaller.cells):
            return None
        matches = [self.cells.index(cells) for cells in smaller.cells]
        for theirs, ours in enumerate(matches):
            cells, size = self.cells[ours], self.sizes[ours]
            if size == corner_count(cells):
                vertices = torch.cartesian_prod(*(torch.arange(side + 1, dtype=torch.int32) for side in cells)).T
                self.tables[self.rows(vertices, ours)] = smaller.tables[smaller.rows(vertices, theirs)]
            else:  # the hashes differ only in the number of bits used
                entries = sum(smaller.sizes[:theirs]) + torch.arange(size) % smaller.sizes[theirs]
                self.tables[sum(self.sizes[:ours]) + torch.arange(size)] = smaller.tables[entries]
        return (features * torch.tensor(matches)[:, None] + torch.arange(features)).flatten()

    @torch.no_grad()
    def prune(self, visible_cells: Bool[Tensor, "G G G"]) -> None:
        """Zeroes the entries that no position in the visible cells reads."""
        read = torch.zeros(len(self.tables), dtype=torch.bool, device=visible_cells.device)
        for level, (side, *_) in enumerate(self.cells):
            read[self.rows(vertices_of_cells(visible_cells, side).nonzero().T.int(), level)] = True
        self.tables[~read] = 0


class HashGridField(Field):
    """Hash-grid features, a small density network, and a small view-dependent color network (Instant-NGP).

    Args:
        bounds: the box the grid covers.
        num_levels: number of grids.
        log2_hashmap_size, features_per_level: see `HashGrid`.
        base_resolution, max_resolution: cells along a side of the first and the last grid.
        width: neurons of the hidden layers (one for density, two for color).
        degree: see `TensoRFField`.
        view_residual: predict a diffuse color from the position and add a view-dependent residual (SNeRG, Hedman et al.
            2021); otherwise one view-dependent color.
        density: "relu", "softplus" or "exp".
        size: "auto" limits both resolutions to what the photos resolve; "fixed" does not.

    Raises:
        InputError: where base_resolution > max_resolution.
    """

    GEOMETRY_FEATURES = 15  # passed from the density to the color network, Instant-NGP section 5.4
    INIT_LOG_DENSITY = -1.0  # an exponential density starts as thin fog
    max_lr = 0.1
    cpu_chunks = 4  # loads each level's table into the core's cache less often

    def __init__(
        self,
        bounds: Bounds,
        num_levels: Layers = 8,
        log2_hashmap_size: Log2Size = 17,
        features_per_level: Count = 2,
        base_resolution: GridSize = 16,
        max_resolution: GridSize = 256,
        width: Count = 64,
        degree: SHDegree = 3,
        view_residual: bool = False,
        density: Activation = "exp",
        size: Size = "auto",
    ):
        super().__init__(bounds)
        cells = cubic_cells(num_levels, *self.limit_resolutions(base_resolution, max_resolution, size))
        self.grid = HashGrid(cells, log2_hashmap_size, features_per_level)
        self.activation = density_activation(density)
        self.density_net = build_layers(self.grid.width, width, 1 + self.GEOMETRY_FEATURES)
        self.terms = num_sh_bases(degree)
        self.view_residual = view_residual
        self.color_net = build_layers(self.GEOMETRY_FEATURES + self.terms, width, width, 3)
        self.has_exp_density = density == "exp"
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Lowers the density bias: starting from dense fog, training may collapse to zero density and zero gradient."""
        if self.has_exp_density:
            self.density_net[-1].get_parameter("bias")[0] = self.INIT_LOG_DENSITY

    def warm_start_from(self, smaller: Field) -> None:
        """Copies a field with the same `view_residual` whose levels are all among this one's."""
        assert isinstance(smaller, HashGridField)
        if self.view_residual != smaller.view_residual or (columns := self.grid.warm_start_from(smaller.grid)) is None:
            return
        widen(linear_layers(self.density_net), linear_layers(smaller.density_net), columns)
        widen(linear_layers(self.color_net), linear_layers(smaller.color_net))

    def prune(self, visible_cells: Bool[Tensor, "G G G"]) -> None:
        self.grid.prune(visible_cells)

    def features(
        self, positions: Float[Tensor, "N 3"], unit_length: float = 1.0
    ) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        """See `Field.features`; the density is divided by `unit_length`."""
        encoded, layers = self.grid(self.bounds.to_unit(positions)), layer_parameters(self.density_net)
        density, geometry = mlp_heads(encoded, layers, 1, None, self.activation, unit_length)
        return density.squeeze(1), geometry

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        return self.features(positions, self.unit_length)[0]

    def forward(self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> FieldOutput:
        density, features = self.features(positions, self.unit_length)
        layers, basis = layer_parameters(self.color_net), encode_directions(directions, self.terms)
        if not self.view_residual:
            return FieldOutput(density, mlp(features, layers, basis, torch.sigmoid))
        logits = mlp(features, layers, basis)
        return FieldOutput(density, torch.sigmoid(features[:, :3] + logits), logits)
