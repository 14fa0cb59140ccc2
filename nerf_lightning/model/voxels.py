"""Sparse voxel grid of densities and spherical-harmonics colors, without a network (Plenoxels, Fridovich-Keil et al. 2022)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.kernels import (
    interpolate_rows,
    interpolate_scalar,
    interpolate_voxels,
    locate_vertices,
    mark_rows,
    total_variation,
    truncated_exp,
)
from nerf_lightning.model.field import Field, FieldOutput, Size
from nerf_lightning.model.growth import ResolutionSchedule, replace_data
from nerf_lightning.model.hashgrid import level_resolutions
from nerf_lightning.model.layers.encoding import encode_directions, num_sh_bases
from nerf_lightning.model.layers.grid_masks import dilate, vertices_of_cells
from nerf_lightning.utils.option_checks import GridSize, Gt, Layers, Le, LossWeight, PositiveFloat, SHDegree

EMPTY_LOG_DENSITY = -8.0
"""Log-density (1 / half-size) of pruned vertices: practically transparent."""
VISIBILITY_WINDOW = 0.5
"""Fraction at the end of a stage; vertices read in it survive pruning."""
TV_SLICES = 4
"""Number of slices of the table; each step computes the total variation of one."""
TABLE_NAMES = ("log_density", "colors", "sh_coefficients")
VERTICES_PER_CHUNK = 1 << 16
"""Vertices interpolated at a time when upsampling, to bound the memory."""
BYTES_PER_VERTEX = 14
"""Memory per grid vertex while upsampling: two masks, the running count and the row."""


class VoxelField(Field):
    """Vertices of a sparse cubic grid, each with log-density, color and spherical-harmonics coefficients.

    All are interpolated trilinearly before the density's exponential and the color's sigmoid, which keeps surfaces sharp
    (DVGO, Sun et al. 2022, section 4). Training starts on a coarse, full grid that is upsampled in stages. Each stage keeps
    only the neighborhood of vertices read in the second half of the previous stage: samplers return only visible samples,
    so this prunes by visibility. Row 0 is the shared constant for pruned vertices.

    Args:
        bounds: the box the grid covers.
        base_resolution, max_resolution: initial and final cells along a side.
        stages: number of resolutions, growing geometrically.
        growth_end: training progress at which the final resolution is reached.
        degree: degree of the spherical harmonics, 0 to 3; 0 makes colors view-independent.
        density_lr_scale: factor on the learning rate of the log-densities, relative to the colors'.
        tv_weight: weight of the total variation of the log-densities (Plenoxels, eq. 3, without the root).
        size: "auto" limits both resolutions to what the photos resolve; "fixed" does not.

    Raises:
        InputError: where base_resolution > max_resolution.
    """

    index: Tensor
    """Row of every vertex; 0 for pruned ones."""
    vertex_of_row: Tensor
    """Vertex of every row, the inverse of `index`."""
    last_read_step: Tensor
    """Step at which each row was last read."""

    def __init__(
        self,
        bounds: Bounds,
        base_resolution: GridSize = 40,
        max_resolution: GridSize = 128,
        stages: Layers = 4,
        growth_end: Annotated[float, Gt(0), Le(1)] = 0.3,
        degree: SHDegree = 1,
        density_lr_scale: PositiveFloat = 6.0,
        tv_weight: LossWeight = 1e-4,
        size: Size = "auto",
    ):
        super().__init__(bounds)
        base_resolution, max_resolution = self.limit_resolutions(base_resolution, max_resolution, size)
        # Early stages are short: a coarse grid converges in few steps.
        starts = [growth_end * (i / max(stages - 1, 1)) ** 2 for i in range(stages)]
        resolutions = level_resolutions(stages, base_resolution, max_resolution)
        self.growth: ResolutionSchedule = ResolutionSchedule(resolutions, starts)
        self.terms = num_sh_bases(degree) - 1  # without the constant
        self.density_lr_scale = density_lr_scale
        # Adam moves an entry by up to its rate per step: log-density steps above 1 create fog in front of cameras.
        self.max_lr = 1 / density_lr_scale
        self.tv_weight = tv_weight
        for name, persistent in (("index", True), ("vertex_of_row", False), ("last_read_step", True)):
            self.register_buffer(name, None, persistent)
        self.stage, self.steps, self.stage_start = 0, 1, 1
        """Growth stage, steps so far, and first step of the stage; on the host, to avoid device syncs."""
        vertices = (self.growth.resolutions[0] + 1) ** 3
        self.log_density = torch.nn.Parameter(torch.zeros(1 + vertices))  # divided by density_lr_scale
        self.log_density.data[0] = EMPTY_LOG_DENSITY / density_lr_scale
        self.colors = torch.nn.Parameter(torch.zeros(1 + vertices, 3))
        self.sh_coefficients = torch.nn.Parameter(torch.zeros(1 + vertices, 3 * self.terms))
        self.set_vertices(torch.ones(vertices, dtype=torch.bool), [table.data for table in self.tables])

    @property
    def tables(self) -> tuple[torch.nn.Parameter, torch.nn.Parameter, torch.nn.Parameter]:
        """Parameter tables, one row per vertex."""
        return self.log_density, self.colors, self.sh_coefficients

    @property
    def training_bytes(self) -> int:
        return max(super().training_bytes, BYTES_PER_VERTEX * (self.growth.resolutions[-1] + 1) ** 3)

    @property
    def occupied(self) -> Bool[Tensor, "V"]:
        """Mask of the vertices with a row."""
        return self.index > 0

    @property
    def side(self) -> int:
        """Current vertices along each side, including pruned ones."""
        return round(len(self.index) ** (1 / 3))

    def density_from_raw(self, raw: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
        """Density (1 / world unit) from values of the table."""
        return truncated_exp(self.density_lr_scale * raw) / self.unit_length

    def density(self, positions: Float[Tensor, "N 3"]) -> Float[Tensor, "N"]:
        """Density of `forward`, without marking vertices as read."""
        return self.density_from_raw(interpolate_scalar(self.log_density, self.index, self.bounds.to_unit(positions)))

    def forward(self, positions: Float[Tensor, "N 3"], directions: Float[Tensor, "N 3"]) -> FieldOutput:
        rows, weights = locate_vertices(self.index, self.bounds.to_unit(positions))
        basis = encode_directions(directions, 1 + self.terms)[:, 1:]
        raw, rgb = interpolate_voxels(self.log_density, self.colors, self.sh_coefficients, rows, weights, basis)
        if torch.is_grad_enabled():
            self.mark_read(rows)
        return FieldOutput(self.density_from_raw(raw), torch.sigmoid(rgb))

    def mark_read(self, rows: Int[Tensor, "N 8"]) -> None:
        """Records the rows read by a training step."""
        self.steps += 1
        mark_rows(self.last_read_step, rows, self.steps)

    def losses(self) -> dict[str, Float[Tensor, ""]]:
        """Total variation of the log-densities, over one slice of the table per step."""
        rows, piece = len(self.vertex_of_row) - 1, self.steps % TV_SLICES
        first, last = (1 + rows * i // TV_SLICES for i in (piece, piece + 1))
        if not self.tv_weight or first == last:
            return {}
        return {"tv": self.tv_weight * total_variation(self.log_density, self.vertex_of_row, self.index, first, last)}

    @torch.no_grad()
    def upsample(self, stage: int) -> list[torch.nn.Parameter]:
        keep = self.vertices_to_keep(self.growth.resolutions[stage] + 1)
        values = torch.cat([table.view(len(table), -1) for table in self.tables], dim=1)
        parts = (keep.nonzero() / (keep.shape[0] - 1)).split(VERTICES_PER_CHUNK)
        new = torch.cat([values[:1], *(interpolate_rows(values, *locate_vertices(self.index, part)) for part in parts)])
        self.set_vertices(keep.flatten(), new.split([1, 3, 3 * self.terms], dim=1))
        self.stage, self.stage_start = stage, self.steps + 1
        return list(self.tables)

    def set_vertices(self, keep: Bool[Tensor, "V"], tables: Sequence[Tensor]) -> None:
        """Replaces the tables: row 0 for pruned vertices, then the kept vertices in order."""
        for table, columns in zip(self.tables, tables, strict=True):
            replace_data(table, columns.reshape(len(columns), *table.shape[1:]).contiguous())
        self.index = torch.where(keep, keep.cumsum(0), 0).int()
        rows = self.index.nonzero()[:, 0]  # in vertex order
        self.vertex_of_row = torch.cat([rows.new_tensor([-1]), rows]).int()
        self.last_read_step = torch.zeros(len(self.vertex_of_row), dtype=torch.int32, device=keep.device)

    @torch.no_grad()
    def warm_start_from(self, smaller: Field) -> None:
        """Copies all tables; `growth` then starts at the copied resolution."""
        assert isinstance(smaller, VoxelField)
        cells = smaller.side - 1
        resolutions = self.growth.resolutions
        if cells > resolutions[-1]:
            return
        self.growth = replace(self.growth, resolutions=level_resolutions(len(resolutions), cells, resolutions[-1]))
        coefficients = smaller.sh_coefficients.view(len(smaller.sh_coefficients), 3, smaller.terms)[..., : self.terms]
        padded = coefficients.new_zeros(len(coefficients), 3, self.terms)
        padded[..., : coefficients.shape[2]] = coefficients
        density = smaller.log_density * (smaller.density_lr_scale / self.density_lr_scale)
        self.set_vertices(smaller.occupied, [density, smaller.colors.detach(), padded.flatten(1)])

    @torch.no_grad()
    def prune(self, visible_cells: Bool[Tensor, "G G G"]) -> None:
        keep = vertices_of_cells(visible_cells, self.side - 1).flatten() & self.occupied
        rows = torch.cat([self.index.new_zeros(1), self.index[keep]]).long()
        self.set_vertices(keep, [table.detach()[rows] for table in self.tables])

    def export_state(self) -> dict[str, Tensor]:
        tables = zip(TABLE_NAMES, self.tables, strict=True)
        return {"occupied": self.occupied, **{name: table.detach() for name, table in tables}}

    def import_state(self, state: dict[str, Tensor]) -> None:
        tables = {name: state[name] for name in TABLE_NAMES}
        self.load_state_dict({"index": state["occupied"].int(), **tables}, strict=False)

    def vertices_to_keep(self, side: int) -> Bool[Tensor, "S S S"]:
        """Mask of the vertices of a grid of side^3 that lie between recently read vertices, dilated by one."""
        recently_read = self.last_read_step > self.steps - VISIBILITY_WINDOW * (self.steps + 1 - self.stage_start)
        recently_read[0] = False
        old = self.side
        keep = recently_read[self.index.long()].view(old, old, old)
        at = torch.arange(side, device=keep.device) * (old - 1) / (side - 1)
        for axis in range(3):
            keep = keep.index_select(axis, at.floor().long()) & keep.index_select(axis, at.ceil().long())
        # Keep all vertices before the first rendering.
        return dilate(keep) if keep.any() else torch.ones_like(keep)

    def get_extra_state(self) -> Tensor:
        return torch.tensor([self.stage, self.steps, self.stage_start])

    def set_extra_state(self, state: Tensor) -> None:
        self.stage, self.steps, self.stage_start = state.tolist()

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Resizes to the loaded state, which may come from another growth stage.

        Raises:
            RuntimeError: if the vertices do not form a cubic grid.
        """
        index = state_dict.get(f"{prefix}index", self.index)
        if index.ndim != 1 or round(len(index) ** (1 / 3)) ** 3 != len(index) or not len(index):
            raise RuntimeError("the vertices in `index` do not form a cubic grid")
        keep = index.to(self.bounds.aabb.device) > 0
        rows = int(keep.sum()) + 1
        self.set_vertices(keep, [table.new_empty(rows, table[0].numel()) for table in self.tables])
        state_dict = {**state_dict, f"{prefix}index": self.index}
        super()._load_from_state_dict(state_dict, prefix, *rest)
