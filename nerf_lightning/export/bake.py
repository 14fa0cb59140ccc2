"""Baking fields for web pages: occupied cells from what the photos see, and voxels where a page cannot draw the field."""

import copy
import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.dataset.ray_datamodule import make_batch
from nerf_lightning.export.compress import MIN_OPACITY, CellMask, sample_views, subsample_cameras
from nerf_lightning.export.volume import MAX_RESOLUTION, MIN_RESOLUTION
from nerf_lightning.kernels import cell_index, volume_weights
from nerf_lightning.model import Field, HashGridField, TensoRFField, VoxelField
from nerf_lightning.model.layers.encoding import encode_directions
from nerf_lightning.model.layers.grid_masks import dilate, vertices_of_cells
from nerf_lightning.model.voxels import EMPTY_LOG_DENSITY
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.text import subsample

GRID_RESOLUTION = 128
"""Cells per axis of an occupancy grid that replaces another sampler."""
STEPS_PER_RAY, UNBOUNDED_STEPS_PER_RAY = 192, 512
"""Steps per ray between its cells."""
MAX_VISIBILITY_RAYS = 150_000
"""Rays over all views by which cells are weighed."""
WEIGHT_SHARE = 0.985
"""Share of the rendering weight that the occupied cells hold, before their dilation. At 0.97 captures trained for minutes lose
1 dB: their weight is spread over many cells of a few rays each."""
SH_DEGREE, MAX_DIRECTIONS = 1, 24
"""Degree of the spherical harmonics baked from a field, and number of view directions they are fitted to."""
RIDGE_DAMPING = 1e-2
"""Ridge regularization of that fit, per direction."""
MAX_LOGIT = 6.0
"""Largest logit of a color: beyond, 8-bit values do not change."""
MAX_VERTICES = 700_000
"""Limit for kept vertices (about 6 MB), unless the user sets the resolution."""
CUBE_MARGIN = 1e-4
"""Margin at the unit cube's faces, which are infinitely far in an unbounded scene."""
POLISH_STEPS, POLISH_RAYS, POLISH_LR = 200, 4096, 0.05
"""Training steps of baked voxels, rays per step, and Adam's learning rate."""
CHUNK_VERTICES = 1 << 14
"""Vertices per batch."""


class BakedSystem(NamedTuple):
    """A system that a web page can render."""

    system: NeRF3D
    config: dict[str, Any]
    """Configuration of the run, with its replaced parts."""
    changes: list[str]
    """Descriptions of replaced parts; if any, the occupied cells are those visible to the cameras."""


def is_drawable(field: Field) -> bool:
    """Whether a web page can draw a field."""
    if isinstance(field, HashGridField):
        return field.grid.tables.shape[1] == 2
    return isinstance(field, TensoRFField | VoxelField)


def is_web_renderable(system: NeRF3D) -> bool:
    """Whether a web page can render a system unchanged."""
    return is_drawable(system.field) and isinstance(system.sampler, OccupancySampler)


def bake_system(system: NeRF3D, data: RayDataModule, config: dict[str, Any], cells: int | None) -> BakedSystem:
    """Returns the system if a page can render it, else a copy with an occupancy sampler, a voxel field, or both.

    Args:
        system: trained.
        data: of its run; what the training views see is kept.
        config: of its run, as plain values.
        cells: voxels per axis of a baked field; None takes the photos' resolution, within limits.
    """
    config = copy.deepcopy(config)
    changes: list[str] = []
    if is_web_renderable(system):
        return BakedSystem(system, config, changes)
    field, sampler, cameras = system.field, system.sampler, subsample_cameras(data)
    baked = copy.copy(system)
    baked._modules = dict(system._modules)  # replaces modules of the copy only
    grid = sampler.grid.resolution if isinstance(sampler, OccupancySampler) else GRID_RESOLUTION
    if is_drawable(field):
        seen = find_weighty_cells(system, cameras, grid)
    else:
        baked.field, options = bake_voxels(system, cameras, cells)
        config["model"] = describe_target(VoxelField, **options)
        changes.append(f"voxels, {baked.field.side - 1} a side, in place of its own field")
        seen = resample_occupancy(baked.field, grid)
    if not isinstance(sampler, OccupancySampler):
        steps = UNBOUNDED_STEPS_PER_RAY if field.bounds.unbounded else STEPS_PER_RAY
        config["sampler"] = describe_target(OccupancySampler, samples=steps, resolution=grid)
        changes.append(f"{steps} steps between {grid} cells a side in place of its own samples")
        sampler = OccupancySampler(field.bounds, steps, grid, chunk=system.chunk)
    baked.sampler = copy.deepcopy(sampler)
    baked.sampler.import_state({"grid.occupied": seen.flatten()})
    baked.sampler.to(system.device)
    if baked.field is not field:
        polish(baked, data)
    return BakedSystem(baked, config, changes)


def describe_target(kind: type, **options: Any) -> dict[str, Any]:
    """The configuration of a module, as plain values."""
    return {"_target_": f"{kind.__module__.rsplit('.', 1)[0]}.{kind.__name__}", **options}


@torch.no_grad()
def bake_voxels(system: NeRF3D, cameras: Cameras, cells: int | None) -> tuple[VoxelField, dict[str, Any]]:
    """Bakes a field into voxels; returns them and their options.

    Args:
        system, cameras, cells: as in `bake_system`.
    """
    bounds = system.field.bounds
    across = cells or min(max(math.ceil(min(bounds.unit_cube_pixels, MAX_RESOLUTION)), MIN_RESOLUTION), MAX_RESOLUTION)
    seen = find_weighty_cells(system, cameras, across)
    while True:
        options: dict[str, Any] = {"base_resolution": across, "max_resolution": across, "stages": 1}
        options |= {"degree": SH_DEGREE, "size": "fixed"}
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
    centers = cameras.centers[torch.tensor(subsample(len(cameras), MAX_DIRECTIONS))].to(system.device)
    parts = [fit_colors(system, part, centers, voxels.terms) for part in positions[chosen].split(CHUNK_VERTICES)]
    colors, views = (torch.cat(column) for column in zip(*parts, strict=True))
    raw = (density[chosen] * voxels.unit_length).log().clamp(EMPTY_LOG_DENSITY, 15.0) / voxels.density_lr_scale
    empty = raw.new_full((1,), EMPTY_LOG_DENSITY / voxels.density_lr_scale)
    empty_row = empty, colors.new_zeros(1, 3), views.new_zeros(1, views.shape[1])
    voxels.set_vertices(keep.flatten(), [torch.cat(pair) for pair in zip(empty_row, (raw, colors, views), strict=True)])
    return voxels, options


@torch.no_grad()
def find_weighty_cells(system: NeRF3D, cameras: Cameras, n: int) -> CellMask:
    """Cells of an n^3 grid over the bounds that hold most of the rendering weight of the cameras' rays, and their neighbors."""
    bounds = system.field.bounds
    pixels = int(cameras.sizes.prod(1).sum())
    cameras = cameras.rescale(min(1.0, math.sqrt(MAX_VISIBILITY_RAYS / pixels)))
    sums = torch.zeros(n**3, device=system.device)
    for rays, samples, density in sample_views(system, cameras):
        weights = volume_weights(density, samples.dt, samples.ray, samples.offsets)
        for end in (-0.5, 0.0, 0.5):  # an interval may cross cells
            along = rays.directions[samples.ray] * (samples.t + end * samples.dt)[:, None]
            sums.index_add_(0, cell_index(bounds.to_unit(rays.origins[samples.ray] + along), n), weights)
    ordered, order = sums.sort(descending=True)
    held = ordered.double().cumsum(0)
    mask = torch.zeros(n**3, dtype=torch.bool, device=system.device)
    mask[order] = (held <= WEIGHT_SHARE * held[-1]) & (ordered > 0)
    return dilate(mask.view(n, n, n))


def polish(baked: NeRF3D, data: RayDataModule) -> None:
    """Trains a baked field on the photos, to recover detail between vertices."""
    photos = data.scene.train
    generator = torch.Generator().manual_seed(baked.seed)
    optimizer = torch.optim.Adam(baked.field.parameters(), POLISH_LR, (0.5, 0.99))
    for step in track_progress(range(POLISH_STEPS), POLISH_STEPS, "steps"):
        optimizer.param_groups[0]["lr"] = POLISH_LR * (1 + math.cos(math.pi * step / POLISH_STEPS)) / 2
        batch = make_batch(photos, photos.sample_pixels(POLISH_RAYS, generator)).to(baked.device)
        with torch.no_grad():
            samples = baked.sampler(batch.rays, baked.field.density, None)
        rendered = baked.renderer(batch.rays, samples, baked.field)
        loss = (rendered.rgb - baked.compute_target_rgb(batch)).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def compute_cell_sizes(bounds: Bounds, positions: Float[Tensor, "N 3"], across: int) -> Float[Tensor, "N"]:
    """Mean side of a grid cell at world positions, world units."""
    unit = bounds.to_unit(positions.clone())
    half = 0.5 / across
    ends = [bounds.to_world((unit + side * half).clamp(CUBE_MARGIN, 1 - CUBE_MARGIN)) for side in (-1, 1)]
    return (ends[1] - ends[0]).norm(dim=1) / math.sqrt(3)


def resample_occupancy(voxels: VoxelField, grid: int) -> CellMask:
    """Marks cells of a grid of resolution `grid` that contain occupied voxels, and their neighbors."""
    occupied = voxels.occupied.view(*[voxels.side] * 3).nonzero()
    x, y, z = (occupied * grid // (voxels.side - 1)).clamp(0, grid - 1).unbind(1)
    mask = torch.zeros(grid, grid, grid, dtype=torch.bool, device=occupied.device)
    mask[x, y, z] = True
    return dilate(mask)


def fit_colors(
    system: NeRF3D, positions: Float[Tensor, "N 3"], centers: Float[Tensor, "D 3"], terms: int
) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N C"]]:
    """Fits the base color and spherical harmonics of vertices to a field's colors, seen from camera centers:
    ridge regression on logits."""
    directions = torch.nn.functional.normalize(positions[:, None] - centers, dim=2)
    repeated = positions[:, None].expand_as(directions).flatten(0, 1)
    rgb = system.field(repeated, directions.flatten(0, 1))[1].view(directions.shape)
    logits = torch.logit(rgb, 1 / (1 + math.exp(MAX_LOGIT)))
    basis = encode_directions(directions.flatten(0, 1), 1 + terms)[:, 1:].view(*directions.shape[:2], -1)
    mean, basis_mean = logits.mean(1, keepdim=True), basis.mean(1, keepdim=True)
    basis = basis - basis_mean
    normal = basis.mT @ basis + RIDGE_DAMPING * len(centers) * torch.eye(terms, device=basis.device)
    views = torch.linalg.solve(normal, basis.mT @ (logits - mean))
    return mean[:, 0] - (basis_mean @ views)[:, 0], views.mT.flatten(1)
