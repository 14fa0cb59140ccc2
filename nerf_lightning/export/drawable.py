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
from nerf_lightning.model.layers.encoding import encode_directions
from nerf_lightning.model.layers.pruning import vertices_in, widened
from nerf_lightning.model.voxels import EMPTY
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.text import subsample

CELLS, STEPS = 128, 192
"""Along a side of the grid, and along a ray, that stand for another sampler."""
DEGREE, DIRECTIONS = 1, 24
"""Of the harmonics that stand for another field's colours, and how many cameras' directions they are fitted to."""
DAMPING = 1e-2
"""Of that fit, per direction: what a few directions do not tell stays near 0."""
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
    changes: list[str]
    """What that was, in words; where there is any, the occupied cells are those that the cameras see."""


def is_drawable(system: NeRF3D) -> bool:
    """Whether a page can draw a system without any change."""
    return isinstance(system.field, TensoRFField | VoxelField) and isinstance(system.sampler, OccupancySampler)


def drawable(system: NeRF3D, cameras: Cameras, config: dict[str, Any], cells: int | None) -> Drawable:
    """The system itself where a page can draw it; otherwise a copy with another field, another sampler, or both.

    Args:
        system: trained.
        cameras: views of the content: what they see is kept.
        config: of its run, as plain values.
        cells: along a side of voxels that stand for another field; None takes as many as photos show, but not too many.
    """
    config = copy.deepcopy(config)
    changes: list[str] = []
    if is_drawable(system):
        return Drawable(system, config, changes)
    field, sampler = system.field, system.sampler
    keeps_field, keeps_sampler = isinstance(field, TensoRFField | VoxelField), isinstance(sampler, OccupancySampler)
    made = copy.copy(system)
    made._modules = dict(system._modules)  # the copy's parts are replaced, not changed
    grid = sampler.grid.resolution if isinstance(sampler, OccupancySampler) else CELLS
    if keeps_field:
        seen = widened(visible_cells(system, cameras, grid))
    else:
        made.field, options = voxels_like(system, cameras, cells)
        config["model"] = target_of(VoxelField, **options)
        changes.append(f"voxels, {made.field.side - 1} a side, in place of its own field")
        seen = cells_around(made.field, grid)
    if not keeps_sampler:
        config["sampler"] = target_of(OccupancySampler, samples=STEPS, resolution=CELLS)
        changes.append(f"{STEPS} steps between {CELLS} cells a side in place of its own samples")
    steps = OccupancySampler(field.bounds, STEPS, CELLS, chunk=system.chunk)
    made.sampler = copy.deepcopy(sampler) if keeps_sampler else steps
    made.sampler.import_state({"grid.occupied": seen.flatten()})
    made.sampler.to(system.device)
    if not keeps_field:
        teach(made, system, cameras)
    return Drawable(made, config, changes)


def target_of(kind: type, **options: Any) -> dict[str, Any]:
    """As configurations name a module."""
    return {"_target_": f"{kind.__module__.rsplit('.', 1)[0]}.{kind.__name__}", **options}


@torch.no_grad()
def voxels_like(system: NeRF3D, cameras: Cameras, cells: int | None) -> tuple[VoxelField, dict[str, Any]]:
    """Voxels with the densities of a system's field, and its colours as some cameras see them, and their options.

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
    centres = cameras.centres[torch.tensor(subsample(len(cameras), DIRECTIONS))].to(system.device)
    found = [fitted(system, part, centres, voxels.terms) for part in places[chosen].split(CHUNK)]
    colours, views = (torch.cat(column) for column in zip(*found, strict=True))
    raw = (density[chosen] * voxels.unit_length).log().clamp(EMPTY, 15.0) / voxels.density_rate
    nothing = (
        raw.new_full((1,), EMPTY / voxels.density_rate),
        colours.new_zeros(1, 3),
        views.new_zeros(1, views.shape[1]),
    )
    voxels.set_vertices(keep.flatten(), [torch.cat(pair) for pair in zip(nothing, (raw, colours, views), strict=True)])
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


def fitted(
    system: NeRF3D, places: Float[Tensor, "N 3"], centres: Float[Tensor, "D 3"], terms: int
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N C"]]:
    """Colours of voxels at some places, and the harmonics closest to how they change between the cameras' directions: by least
    squares, before the sigmoid."""
    directions = torch.nn.functional.normalize(places[:, None] - centres, dim=2)
    several = places[:, None].expand_as(directions).flatten(0, 1)
    rgb = system.field(several, directions.flatten(0, 1))[1].view(directions.shape)
    logits = torch.logit(rgb, 1 / (1 + math.exp(LOGITS)))
    basis = encode_directions(directions.flatten(0, 1), 1 + terms)[:, 1:].view(*directions.shape[:2], -1)
    mean, middle = logits.mean(1, keepdim=True), basis.mean(1, keepdim=True)
    basis = basis - middle
    normal = basis.mT @ basis + DAMPING * len(centres) * torch.eye(terms, device=basis.device)
    views = torch.linalg.solve(normal, basis.mT @ (logits - mean))
    return mean[:, 0] - (middle @ views)[:, 0], views.mT.flatten(1)
