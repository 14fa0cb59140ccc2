"""Which cells some cameras see: all that rendering from around them needs."""

import copy
import math
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.model.layers.pruning import widened
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.progress import tracked

NOTHING = 1e-3
"""Opacity below which a step is empty."""
FINEST = 8
"""Most rays along a pixel's side."""

Cells = Bool[Tensor, "G G G"]
"""A mask over the cells of a sampler's grid."""


def occupied_cells(system: System) -> Cells | None:
    """Cells in which the sampler looks for something; None for a sampler without a grid."""
    sampler = system.parts.get("sampler")
    return sampler.grid.occupied.view(*[sampler.grid.resolution] * 3) if isinstance(sampler, OccupancySampler) else None


def seen_cells(system: NeRF3D, cameras: Cameras) -> Cells | None:
    """The occupied cells that are visible to the cameras, and their neighbours."""
    occupied = occupied_cells(system)
    if occupied is None:
        return None
    return widened(visible_cells(system, cameras, len(occupied))) & occupied


@torch.no_grad()
def visible_cells(system: NeRF3D, cameras: Cameras, n: int) -> Cells:
    """The cells of a grid of n^3 over the bounds in which some camera sees something.

    Rays are as close to each other at the content as cells are.
    """
    bounds = system.field.bounds
    cell = (4 if bounds.unbounded else 2) * bounds.longest / n
    times = min(FINEST, math.ceil(cameras.pixel_width(bounds.centre.cpu()) / cell))
    fine = cameras.scaled(times)
    seen = torch.zeros(n**3, dtype=torch.bool, device=system.device)
    for view in tracked(range(len(fine)), len(fine), "views"):
        rays = fine.view_rays(view)
        for start in range(0, len(rays), system.chunk_rays):
            chunk = rays[start : start + system.chunk_rays].to(system.device)
            samples = system.sampler(chunk, system.field.density)
            positions = samples.positions(chunk)
            opacity = 1 - torch.exp(-system.field.density(positions) * samples.dt)
            x, y, z = (bounds.to_unit(positions[opacity > NOTHING]) * n).long().clamp(0, n - 1).unbind(1)
            seen[(x * n + y) * n + z] = True
    return seen.view(n, n, n)


def confined_to(system: System, cells: Cells | None) -> System:
    """A copy of a system with only what some cells need, on the CPU, to be encoded; the system itself for None."""
    if cells is None:
        return system
    part: Any = copy.deepcopy(system).cpu()
    part.field.prune(cells.cpu())
    part.sampler.import_state({"occupied": cells.cpu().flatten()})
    return part
