"""Sampling a field's density on a regular grid of cubic cells."""

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
"""Limits of the default number of cells along the longest side."""
CELL_WIDTH_PIXELS = 1.25
"""Cell side in pixels: smaller cells add only noise to the surface."""
POSITIONS_PER_SAMPLE = 4
"""Positions per field query, relative to the system's sample chunk: bounds the memory."""
BYTES_PER_CELL = 32
"""Memory per cell: density, opacity, index and center."""


@dataclass(frozen=True)
class Volume:
    """A grid of densities. Cell (i, j, k) is centered at low + (i + 0.5, j + 0.5, k + 0.5) * cell, world frame."""

    density: Float[Tensor, "X Y Z"]
    """1 / world unit."""
    low: Float[Tensor, "3"]
    cell: float
    """Side of a cell, world units."""

    @property
    def opacity(self) -> Float[Tensor, "X Y Z"]:
        """Opacity of each cell: 1 - exp(-density * cell)."""
        return 1 - torch.exp(-self.density * self.cell)

    def index_to_world(self, index: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World positions of indices; integers are cell centers."""
        return self.low + (index + 0.5) * self.cell

    @property
    def to_world(self) -> Float[Tensor, "4 4"]:
        """Index-to-world matrix, float64; integers are cell centers."""
        matrix = torch.eye(4, dtype=torch.float64)
        matrix[:3, :3] *= self.cell
        matrix[:3, 3] = self.low.double() + self.cell / 2
        return matrix

    @property
    def centers(self) -> Float[Tensor, "X Y Z 3"]:
        """World positions of all cell centers."""
        axes = [torch.arange(count).float() for count in self.density.shape]
        return self.index_to_world(torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1))


def find_region(bounds: Bounds, box: Float[Tensor, "2 3"], to_source: Float[Tensor, "4 4"]) -> Float[Tensor, "2 3"]:
    """World-frame bounding box of a box in the dataset's frame, clipped to the bounds.

    Args:
        box: lower and upper corner in the dataset's frame.
        to_source: similarity from the world frame to the dataset's.

    Raises:
        InputError: the box is outside the bounds.
    """
    corners = transform_points(torch.linalg.inv(to_source), torch.cartesian_prod(*box.double().T)).float()
    aabb = bounds.aabb.cpu()
    region = torch.stack([torch.maximum(corners.amin(0), aabb[0]), torch.minimum(corners.amax(0), aabb[1])])
    if not (region[0] < region[1]).all():
        limits = transform_points(to_source, torch.cartesian_prod(*aabb.double().T)).aminmax(dim=0)
        low, high = ([round(x, 4) for x in corner.tolist()] for corner in limits)
        expected = f"something within {low} to {high}, the scene's box"
        raise InputError("export", "box", str(box.flatten().tolist()), expected)
    return region


@torch.no_grad()
def sample_volume(
    run: LoadedSceneRun, resolution: int | None = None, box: Float[Tensor, "2 3"] | None = None
) -> Volume:
    """Samples a field's density in occupied cells; zero elsewhere.

    Args:
        run: of a scene.
        resolution: cells along the longest side; None: cells of `CELL_WIDTH_PIXELS`, within limits.
        box: lower and upper corner of a crop, in the dataset's frame.

    Raises:
        InputError: the box is outside the scene's.
    """
    system, bounds = run.system, run.system.field.bounds
    region = bounds.aabb.cpu() if box is None else find_region(bounds, box, run.to_source)
    sides, footprint = region[1] - region[0], bounds.pixel_footprint
    if resolution is None:
        across = float(sides.max()) / (CELL_WIDTH_PIXELS * footprint) if footprint else math.inf
        resolution = round(min(max(across, MIN_RESOLUTION), MAX_RESOLUTION))
    cell = float(sides.max()) / resolution
    shape = [max(1, math.ceil(float(side) / cell - 1e-6)) for side in sides]
    count = math.prod(shape)
    check_memory("export", "resolution", f"{count:,} cells", BYTES_PER_CELL * count)
    # Cubic cells may exceed the region, equally on both sides.
    volume = Volume(torch.zeros(shape), region.mean(0) - torch.tensor(shape) * (cell / 2), cell)
    occupied = get_occupied_cells(system)
    batch_size = POSITIONS_PER_SAMPLE * system.chunk
    density = []
    for part in track_progress(volume.centers.view(-1, 3).split(batch_size), math.ceil(count / batch_size), "cells"):
        positions = part.to(system.device)
        unit = bounds.to_unit(positions)
        mask = ((unit >= 0) & (unit <= 1)).all(1)
        if box is not None:  # the region is its bounding box in a rotated frame
            in_file = transform_points(run.to_source, part.double())
            mask &= ((in_file >= box[0]) & (in_file <= box[1])).all(1).to(system.device)
        if occupied is not None:
            n = len(occupied)
            x, y, z = (unit * n).long().clamp(0, n - 1).unbind(1)
            mask &= occupied[x, y, z]
        values = torch.zeros(len(positions), device=system.device)
        values[mask] = system.field.density(positions[mask])
        density.append(values.cpu())
    return replace(volume, density=torch.cat(density).view(shape).nan_to_num(0.0).clamp_min(0.0))
