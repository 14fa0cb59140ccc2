"""A scene's field as a page can draw it: planes and lines or voxels, between the occupied cells of a grid."""

import copy
import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.export.smallest import NOTHING, Cells, visible_cells
from nerf_lightning.export.volume import COARSEST, FINEST
from nerf_lightning.model import TensoRFField, VoxelField
from nerf_lightning.model.layers.pruning import vertices_in, widened
from nerf_lightning.model.voxels import EMPTY
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.progress import tracked

CELLS, STEPS = 128, 192
"""Along a side of the grid, and along a ray, that stand for another sampler."""
DEGREE = 1
"""Of the harmonics that stand for another field's colours."""
LOGITS = 6.0
"""Largest: beyond, a byte does not change."""
MOST = 700_000
"""Vertices that are kept, unless the user gives their cells: some six megabytes."""
EDGE = 1e-4
"""Distance to the unit cube's sides within which there is nothing: in an unbounded scene, they are infinitely far."""
LESSONS, BATCH, RATE = 400, 4096, 0.05
"""Steps, rays of each, and Adam's learning rate, with which voxels learn from the field they stand for."""
CHUNK = 1 << 14
"""Vertices at a time."""


class Drawable(NamedTuple):
    """A system that a page can draw."""

    system: NeRF3D
    config: dict[str, Any]
    """Of its run, with what was put in the place of the run's own."""
    change: str
    """What that was, in words; where there is any, the occupied cells are those that the cameras see."""


def is_drawable(system: NeRF3D) -> bool:
    """Whether a page can draw a system without any change."""
    return isinstance(system.field, TensoRFField | VoxelField) and isinstance(system.sampler, OccupancySampler)


def drawable(system: NeRF3D, cameras: Cameras, config: dict[str, Any], cells: int | None) -> Drawable:
    """The system itself where a page can draw it; otherwise a copy with voxels and an occupancy grid.

    Args:
        system: trained.
        cameras: views of the content: what they see is kept.
        config: of its run, as plain values.
        cells: along a side of the voxels; None takes as many as photos show, but not too many.
    """
    if is_drawable(system):
        return Drawable(system, config, "")
    field, options = voxels_like(system, cameras, cells)
    sampler = OccupancySampler(field.bounds, STEPS, CELLS, chunk=system.chunk)
    sampler.import_state({"grid.occupied": cells_around(field, CELLS).flatten()})
    made = copy.copy(system)
    made._modules = {**system._modules, "field": field, "sampler": sampler.to(system.device)}
    teach(made, system, cameras)
    replaced = {
        "model": target_of(VoxelField, **options),
        "sampler": target_of(OccupancySampler, samples=STEPS, resolution=CELLS),
    }
    return Drawable(made, config | replaced, f"voxels, {field.side - 1} a side, in place of its own field")


def target_of(kind: type, **options: Any) -> dict[str, Any]:
    """As configurations name a module."""
    return {"_target_": f"{kind.__module__.rsplit('.', 1)[0]}.{kind.__name__}", **options}


@torch.no_grad()
def voxels_like(system: NeRF3D, cameras: Cameras, cells: int | None) -> tuple[VoxelField, dict[str, Any]]:
    """Voxels with the densities of a system's field and its colours as the nearest camera sees them, and their options.

    Args:
        system, cameras, cells: as in `drawable`.
    """
    bounds = system.field.bounds
    across = cells or min(max(math.ceil(min(bounds.pixels_across, FINEST)), COARSEST), FINEST)
    seen = widened(visible_cells(system, cameras, across))
    while True:
        options: dict[str, Any] = {"coarsest": across, "finest": across, "stages": 1, "degree": DEGREE, "size": "fixed"}
        voxels = VoxelField(bounds, **options).to(system.device)
        vertices = vertices_in(seen, across)
        places = bounds.to_world((vertices.nonzero() / across).clamp(EDGE, 1 - EDGE))
        density = torch.cat([system.field.density(part) for part in places.split(CHUNK)])
        keep = torch.zeros_like(vertices)
        keep[vertices] = density * cell_sizes(bounds, places, across) > NOTHING
        keep = widened(keep) & vertices
        count = int(keep.sum())
        if cells is not None or count <= MOST or across == COARSEST:
            break
        across = max(COARSEST, min(across - 1, int(across * math.sqrt(MOST / count))))
    chosen = keep[vertices]
    centres = cameras.centres.to(system.device)
    colours = []
    for part in places[chosen].split(CHUNK):
        nearest = centres[torch.cdist(part, centres).argmin(1)]
        rgb = system.field(part, torch.nn.functional.normalize(part - nearest, dim=1))[1]
        colours.append(torch.logit(rgb, 1 / (1 + math.exp(LOGITS))))
    raw = (density[chosen] * voxels.unit_length).log().clamp(EMPTY, 15.0) / voxels.density_rate
    empty = torch.full_like(raw[:1], EMPTY / voxels.density_rate)
    rows = torch.cat([torch.zeros_like(places[:1]), *colours])
    views = rows.new_zeros(len(rows), 3 * voxels.terms)
    voxels.set_vertices(keep.flatten(), [torch.cat([empty, raw]), rows, views])
    return voxels, options


def teach(made: NeRF3D, system: NeRF3D, cameras: Cameras) -> None:
    """Lets a new field learn from pictures that the old one renders: what lies between vertices is otherwise lost."""
    rays, colours = [], []
    for view in tracked(range(len(cameras)), len(cameras), "views"):
        rays.append(cameras.view_rays(view))
        with torch.no_grad():
            colours.append(system.render(rays[-1].to(system.device)).rgb.cpu())
    origins, directions, truth = (
        torch.cat(x) for x in ([r.origins for r in rays], [r.directions for r in rays], colours)
    )
    generator = torch.Generator(system.device).manual_seed(system.seed)
    optimizer = torch.optim.Adam(made.field.parameters(), RATE, (0.5, 0.99))
    for step in tracked(range(LESSONS), LESSONS, "steps"):
        optimizer.param_groups[0]["lr"] = RATE * (1 + math.cos(math.pi * step / LESSONS)) / 2
        chosen = torch.randint(len(truth), (BATCH,), generator=generator, device=system.device).cpu()
        some = Rays(origins[chosen], directions[chosen]).to(system.device)
        with torch.no_grad():
            samples = made.sampler(some, made.field.density, None)
        seen = made.renderer(some, samples, made.field)
        loss = (seen.rgb - truth[chosen].to(system.device)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def cell_sizes(bounds: Bounds, places: Float[Tensor, "N 3"], across: int) -> Float[Tensor, "N"]:
    """How large a cell of a grid over the bounds is at world places: the mean over its sides, world units."""
    unit = bounds.to_unit(places.clone())
    half = 0.5 / across
    ends = [bounds.to_world((unit + side * half).clamp(EDGE, 1 - EDGE)) for side in (-1, 1)]
    return (ends[1] - ends[0]).norm(dim=1) / math.sqrt(3)


def cells_around(voxels: VoxelField, grid: int) -> Cells:
    """The cells of another grid in which voxels hold something, and their neighbours."""
    kept = voxels.kept.view(*[voxels.side] * 3).nonzero()
    x, y, z = (kept * grid // (voxels.side - 1)).clamp(0, grid - 1).unbind(1)
    found = torch.zeros(grid, grid, grid, dtype=torch.bool, device=kept.device)
    found[x, y, z] = True
    return widened(found)
