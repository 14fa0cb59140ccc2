"""A scene's field as a page can draw it: planes and lines or voxels, between the occupied cells of a grid."""

import copy
import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays
from nerf_lightning.export.compress import MIN_OPACITY, CellMask, find_visible_cells
from nerf_lightning.export.volume import MAX_RESOLUTION, MIN_RESOLUTION
from nerf_lightning.model import TensoRFField, VoxelField
from nerf_lightning.model.layers.encoding import encode_directions
from nerf_lightning.model.layers.grid_masks import dilate, vertices_of_cells
from nerf_lightning.model.voxels import EMPTY_LOG_DENSITY
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.text import subsample

GRID_RESOLUTION, STEPS_PER_RAY = 128, 192
"""Along a side of the grid, and along a ray, that stand for another sampler."""
SH_DEGREE, MAX_DIRECTIONS = 1, 24
"""Of the harmonics that stand for another field's colours, and how many cameras' directions they are fitted to."""
RIDGE_DAMPING = 1e-2
"""Of that fit, per direction: what a few directions do not tell stays near 0."""
MAX_LOGIT = 6.0
"""Largest: beyond, a byte does not change."""
MAX_VERTICES = 700_000
"""Vertices that are kept, unless the user gives their cells: some six megabytes."""
CUBE_MARGIN = 1e-4
"""Distance to the unit cube's sides within which there is nothing: in an unbounded scene, they are infinitely far."""
DISTILL_STEPS, DISTILL_RAYS, DISTILL_LR = 400, 4096, 0.05
"""Steps, rays of each, and Adam's learning rate, with which voxels learn from the field they stand for."""
CHUNK_VERTICES = 1 << 14
"""Vertices at a time."""


class BakedSystem(NamedTuple):
    """A system that a page can draw."""

    system: NeRF3D
    config: dict[str, Any]
    """Of its run, with what was put in the place of the run's own."""
    changes: list[str]
    """What that was, in words; where there is any, the occupied cells are those that the cameras see."""


def is_web_renderable(system: NeRF3D) -> bool:
    """Whether a page can draw a system without any change."""
    return isinstance(system.field, TensoRFField | VoxelField) and isinstance(system.sampler, OccupancySampler)


def bake_system(system: NeRF3D, cameras: Cameras, config: dict[str, Any], cells: int | None) -> BakedSystem:
    """The system itself where a page can draw it; otherwise a copy with another field, another sampler, or both.

    Args:
        system: trained.
        cameras: views of the content: what they see is kept.
        config: of its run, as plain values.
        cells: along a side of voxels that stand for another field; None takes as many as photos show, but not too many.
    """
    config = copy.deepcopy(config)
    changes: list[str] = []
    if is_web_renderable(system):
        return BakedSystem(system, config, changes)
    field, sampler = system.field, system.sampler
    keeps_field, keeps_sampler = isinstance(field, TensoRFField | VoxelField), isinstance(sampler, OccupancySampler)
    made = copy.copy(system)
    made._modules = dict(system._modules)  # the copy's parts are replaced, not changed
    grid = sampler.grid.resolution if isinstance(sampler, OccupancySampler) else GRID_RESOLUTION
    if keeps_field:
        seen = dilate(find_visible_cells(system, cameras, grid))
    else:
        made.field, options = bake_voxels(system, cameras, cells)
        config["model"] = describe_target(VoxelField, **options)
        changes.append(f"voxels, {made.field.side - 1} a side, in place of its own field")
        seen = resample_occupancy(made.field, grid)
    if not keeps_sampler:
        config["sampler"] = describe_target(OccupancySampler, samples=STEPS_PER_RAY, resolution=GRID_RESOLUTION)
        changes.append(f"{STEPS_PER_RAY} steps between {GRID_RESOLUTION} cells a side in place of its own samples")
    steps = OccupancySampler(field.bounds, STEPS_PER_RAY, GRID_RESOLUTION, chunk=system.chunk)
    made.sampler = copy.deepcopy(sampler) if keeps_sampler else steps
    made.sampler.import_state({"grid.occupied": seen.flatten()})
    made.sampler.to(system.device)
    if not keeps_field:
        distill(made, system, cameras)
    return BakedSystem(made, config, changes)


def describe_target(kind: type, **options: Any) -> dict[str, Any]:
    """As configurations name a module."""
    return {"_target_": f"{kind.__module__.rsplit('.', 1)[0]}.{kind.__name__}", **options}


@torch.no_grad()
def bake_voxels(system: NeRF3D, cameras: Cameras, cells: int | None) -> tuple[VoxelField, dict[str, Any]]:
    """Voxels with the densities of a system's field, and its colours as some cameras see them, and their options.

    Args:
        system, cameras, cells: as in `drawable`.
    """
    bounds = system.field.bounds
    across = cells or min(max(math.ceil(min(bounds.unit_cube_pixels, MAX_RESOLUTION)), MIN_RESOLUTION), MAX_RESOLUTION)
    seen = dilate(find_visible_cells(system, cameras, across))
    while True:
        options: dict[str, Any] = {
            "base_resolution": across,
            "max_resolution": across,
            "stages": 1,
            "degree": SH_DEGREE,
            "size": "fixed",
        }
        voxels = VoxelField(bounds, **options).to(system.device)
        vertices = vertices_of_cells(seen, across)
        positions = bounds.to_world((vertices.nonzero() / across).clamp(CUBE_MARGIN, 1 - CUBE_MARGIN))
        density = torch.cat([system.field.density(part) for part in positions.split(CHUNK_VERTICES)])
        keep = torch.zeros_like(vertices)
        keep[vertices] = density * compute_cell_sizes(bounds, positions, across) > MIN_OPACITY
        keep = dilate(keep) & vertices
        count = int(keep.sum())
        if cells is not None or count <= MAX_VERTICES or across == MIN_RESOLUTION:
            break
        across = max(MIN_RESOLUTION, min(across - 1, int(across * math.sqrt(MAX_VERTICES / count))))
    chosen = keep[vertices]
    centres = cameras.centres[torch.tensor(subsample(len(cameras), MAX_DIRECTIONS))].to(system.device)
    found = [fit_colours(system, part, centres, voxels.terms) for part in positions[chosen].split(CHUNK_VERTICES)]
    colours, views = (torch.cat(column) for column in zip(*found, strict=True))
    raw = (density[chosen] * voxels.unit_length).log().clamp(EMPTY_LOG_DENSITY, 15.0) / voxels.density_lr_scale
    nothing = (
        raw.new_full((1,), EMPTY_LOG_DENSITY / voxels.density_lr_scale),
        colours.new_zeros(1, 3),
        views.new_zeros(1, views.shape[1]),
    )
    voxels.set_vertices(keep.flatten(), [torch.cat(pair) for pair in zip(nothing, (raw, colours, views), strict=True)])
    return voxels, options


def distill(made: NeRF3D, system: NeRF3D, cameras: Cameras) -> None:
    """Lets a new field learn from pictures that the old one renders: what lies between vertices is otherwise lost."""
    rays, colours = [], []
    for view in track_progress(range(len(cameras)), len(cameras), "views"):
        rays.append(cameras.generate_view_rays(view))
        with torch.no_grad():
            colours.append(system.render(rays[-1].to(system.device)).rgb.cpu())
    origins, directions, truth = (
        torch.cat(x) for x in ([r.origins for r in rays], [r.directions for r in rays], colours)
    )
    generator = torch.Generator(system.device).manual_seed(system.seed)
    optimizer = torch.optim.Adam(made.field.parameters(), DISTILL_LR, (0.5, 0.99))
    for step in track_progress(range(DISTILL_STEPS), DISTILL_STEPS, "steps"):
        optimizer.param_groups[0]["lr"] = DISTILL_LR * (1 + math.cos(math.pi * step / DISTILL_STEPS)) / 2
        chosen = torch.randint(len(truth), (DISTILL_RAYS,), generator=generator, device=system.device).cpu()
        some = Rays(origins[chosen], directions[chosen]).to(system.device)
        with torch.no_grad():
            samples = made.sampler(some, made.field.density, None)
        seen = made.renderer(some, samples, made.field)
        loss = (seen.rgb - truth[chosen].to(system.device)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def compute_cell_sizes(bounds: Bounds, positions: Float[Tensor, "N 3"], across: int) -> Float[Tensor, "N"]:
    """How large a cell of a grid over the bounds is at world places: the mean over its sides, world units."""
    unit = bounds.to_unit(positions.clone())
    half = 0.5 / across
    ends = [bounds.to_world((unit + side * half).clamp(CUBE_MARGIN, 1 - CUBE_MARGIN)) for side in (-1, 1)]
    return (ends[1] - ends[0]).norm(dim=1) / math.sqrt(3)


def resample_occupancy(voxels: VoxelField, grid: int) -> CellMask:
    """The cells of another grid in which voxels hold something, and their neighbours."""
    kept = voxels.occupied.view(*[voxels.side] * 3).nonzero()
    x, y, z = (kept * grid // (voxels.side - 1)).clamp(0, grid - 1).unbind(1)
    found = torch.zeros(grid, grid, grid, dtype=torch.bool, device=kept.device)
    found[x, y, z] = True
    return dilate(found)


def fit_colours(
    system: NeRF3D, positions: Float[Tensor, "N 3"], centres: Float[Tensor, "D 3"], terms: int
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N C"]]:
    """Colours of voxels at some places, and the harmonics closest to how they change between the cameras' directions: by least
    squares, before the sigmoid."""
    directions = torch.nn.functional.normalize(positions[:, None] - centres, dim=2)
    several = positions[:, None].expand_as(directions).flatten(0, 1)
    rgb = system.field(several, directions.flatten(0, 1))[1].view(directions.shape)
    logits = torch.logit(rgb, 1 / (1 + math.exp(MAX_LOGIT)))
    basis = encode_directions(directions.flatten(0, 1), 1 + terms)[:, 1:].view(*directions.shape[:2], -1)
    mean, middle = logits.mean(1, keepdim=True), basis.mean(1, keepdim=True)
    basis = basis - middle
    normal = basis.mT @ basis + RIDGE_DAMPING * len(centres) * torch.eye(terms, device=basis.device)
    views = torch.linalg.solve(normal, basis.mT @ (logits - mean))
    return mean[:, 0] - (middle @ views)[:, 0], views.mT.flatten(1)
