"""Where the light of some cameras ends up: all that a scene seen from around them can show."""

from collections.abc import Iterable

import torch
from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.cameras import Rays
from nerf_lightning.model.pruning import widened
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.nerf3d import RENDER_RAYS

NOTHING = 1e-3
"""Opacity of a step below which there is nothing in it."""


@torch.no_grad()
def reached_cells(system: NeRF3D, views: Iterable[Rays]) -> Bool[Tensor, "G G G"] | None:
    """Cells of the sampler's grid in which light along rays meets anything, and their neighbours.

    None for a sampler without such a grid.
    """
    sampler = system.sampler
    if not isinstance(sampler, OccupancySampler):
        return None
    n = sampler.resolution
    reached = torch.zeros(n**3, dtype=torch.bool, device=system.device)
    for rays in views:
        for start in range(0, len(rays), RENDER_RAYS):
            chunk = rays[start : start + RENDER_RAYS].to(system.device)
            samples = sampler(chunk, system.field.density)
            positions = samples.positions(chunk)
            cells = (sampler.bounds.to_unit(positions) * n).long().clamp(0, n - 1)
            opacity = 1 - torch.exp(-system.field.density(positions) * samples.dt)
            x, y, z = cells[opacity > NOTHING].unbind(1)
            reached[(x * n + y) * n + z] = True
    return widened(reached.view(n, n, n)) & sampler.occupied.view(n, n, n)


def confine(system: NeRF3D, reached: Bool[Tensor, "G G G"]) -> None:
    """Leaves a system only what the reached cells need."""
    system.field.prune(reached)
    system.sampler.unpack({"occupied": reached.flatten()})
