"""A field as a grid of numbers: density and colour at the centres of cubic cells."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, transform_points
from nerf_lightning.errors import InputError
from nerf_lightning.export.compress import get_occupied_cells
from nerf_lightning.runs.open import LoadedSceneRun
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.progress import track_progress

MIN_RESOLUTION, MAX_RESOLUTION = 64, 256
"""Limits for the cells along the longest side, if the user gives no number."""
CELL_WIDTH_PIXELS = 1.25
"""Width of a cell in pixels: cells of one pixel add only noise to the surface."""
POSITIONS_PER_SAMPLE = 4
"""Places evaluated in one call, for each sample rendered in one: bounds the memory."""

BYTES_PER_CELL = 32
"""Bytes of a cell: its density, its opacity, its index and its centre."""


@dataclass(frozen=True)
class Volume:
    """Densities in cubic cells. Cell (i, j, k) has its centre at low + (i + 0.5, j + 0.5, k + 0.5) * cell, world frame."""

    density: Float[Tensor, "X Y Z"]
    """1 / world unit."""
    low: Float[Tensor, "3"]
    cell: float
    """Side of a cell, world units."""

    @property
    def opacity(self) -> Float[Tensor, "X Y Z"]:
        """Of one cell, crossed straight: 1 - exp(-density * cell)."""
        return 1 - torch.exp(-self.density * self.cell)

    def index_to_world(self, index: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Where in the world an index is; whole numbers are centres of cells."""
        return self.low + (index + 0.5) * self.cell

    @property
    def to_world(self) -> Float[Tensor, "4 4"]:
        """Maps indices to the world frame, in double precision; whole numbers are centres of cells."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] *= self.cell
        matrix[:3, 3] = self.low.double() + self.cell / 2
        return matrix

    @property
    def centres(self) -> Float[Tensor, "X Y Z 3"]:
        """Where in the world the centres of all cells are."""
        axes = [torch.arange(count).float() for count in self.density.shape]
        return self.index_to_world(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1))


def find_region(bounds: Bounds, box: Float[Tensor, "2 3"], to_source: Float[Tensor, "4 4"]) -> Float[Tensor, "2 3"]:
    """Lower and upper corner of the part of some bounds, world frame, that holds a box of another frame.

    Args:
        box: lower and upper corner in the frame of the photos' own file.
        to_source: similarity from the world frame to that one.

    Raises:
        InputError: where the box lies outside the bounds.
    """
    corners = transform_points(torch.linalg.inv(to_source), torch.cartesian_prod(*box.double().T)).float()
    aabb = bounds.aabb.cpu()
    region = torch.stack([torch.maximum(corners.amin(0), aabb[0]), torch.minimum(corners.amax(0), aabb[1])])
    if not (region[0] < region[1]).all():
        where = transform_points(to_source, torch.cartesian_prod(*aabb.double().T))
        low, high = ([round(x, 4) for x in corner.tolist()] for corner in (where.amin(0), where.amax(0)))
        raise InputError(
            "export", "box", str(box.flatten().tolist()), f"something within {low} to {high}, the scene's box"
        )
    return region


@torch.no_grad()
def sample_volume(
    run: LoadedSceneRun, resolution: int | None = None, box: Float[Tensor, "2 3"] | None = None
) -> Volume:
    """Samples a field's density in the cells that its sampler marks as occupied; it is zero elsewhere.

    Args:
        run: of a scene.
        resolution: cells along the longest side; None takes somewhat larger ones than a pixel of the photos, within limits.
        box: lower and upper corner of the part to sample, in the frame of the photos' own file; None takes all.

    Raises:
        InputError: where the box lies outside the scene's.
    """
    system, bounds = run.system, run.system.field.bounds
    region = bounds.aabb.cpu() if box is None else find_region(bounds, box, run.to_source)
    sides = region[1] - region[0]
    if resolution is None:
        across = (
            float(sides.max()) / (CELL_WIDTH_PIXELS * bounds.pixel_footprint) if bounds.pixel_footprint else math.inf
        )
        resolution = round(min(max(across, MIN_RESOLUTION), MAX_RESOLUTION))
    cell = float(sides.max()) / resolution
    shape = [max(1, math.ceil(float(side) / cell - 1e-6)) for side in sides]
    count = math.prod(shape)
    check_memory("export", "resolution", f"{count:,} cells", BYTES_PER_CELL * count)
    # Cubic cells may reach beyond the region: equally on both sides.
    volume = Volume(torch.zeros(shape), region.mean(0) - torch.tensor(shape) * (cell / 2), cell)
    occupied = get_occupied_cells(system)
    together = POSITIONS_PER_SAMPLE * system.chunk
    density = []
    for part in track_progress(volume.centres.view(-1, 3).split(together), math.ceil(count / together), "cells"):
        places = part.to(system.device)
        unit = bounds.to_unit(places)
        asked = ((unit >= 0) & (unit <= 1)).all(1)
        if box is not None:  # the region may be larger, as its axes are others
            in_file = transform_points(run.to_source, part.double())
            asked &= ((in_file >= box[0]) & (in_file <= box[1])).all(1).to(system.device)
        if occupied is not None:
            n = len(occupied)
            x, y, z = (unit * n).long().clamp(0, n - 1).unbind(1)
            asked &= occupied[x, y, z]
        found = torch.zeros(len(places), device=system.device)
        found[asked] = system.field.density(places[asked])
        density.append(found.cpu())
    return replace(volume, density=torch.cat(density).view(shape).nan_to_num(0.0).clamp_min(0.0))
