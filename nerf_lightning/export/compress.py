"""The smallest compact file of a run that still shows what the run shows: all that its photos' cameras see."""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset import DataModule
from nerf_lightning.errors import InputError
from nerf_lightning.model.layers.grid_masks import dilate
from nerf_lightning.runs.compact import decode, encode
from nerf_lightning.runs.scene_file import scene_to_dict
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.text import subsample

MAX_VISIBILITY_VIEWS = 60
"""Training views whose rays show which cells matter."""
PRECISIONS = ("byte", "half")
"""Smallest first."""
MIN_OPACITY = 1e-3
"""Opacity below which a step is empty."""
MAX_RAYS_PER_PIXEL_SIDE = 8
"""Most rays along a pixel's side."""

CellMask = Bool[Tensor, "G G G"]
"""A mask over the cells of a sampler's grid."""


def get_occupied_cells(system: System) -> CellMask | None:
    """Cells in which the sampler looks for something; None for a sampler without a grid."""
    sampler = system.exportable_modules.get("sampler")
    return sampler.grid.occupied.view(*[sampler.grid.resolution] * 3) if isinstance(sampler, OccupancySampler) else None


def find_seen_cells(system: NeRF3D, cameras: Cameras) -> CellMask | None:
    """The occupied cells that are visible to the cameras, and their neighbours."""
    occupied = get_occupied_cells(system)
    if occupied is None:
        return None
    return dilate(find_visible_cells(system, cameras, len(occupied))) & occupied


@torch.no_grad()
def find_visible_cells(system: NeRF3D, cameras: Cameras, n: int) -> CellMask:
    """The cells of a grid of n^3 over the bounds in which some camera sees something.

    Rays are as close to each other at the content as cells are.
    """
    bounds = system.field.bounds
    cell = (4 if bounds.unbounded else 2) * bounds.max_half_size / n
    times = min(MAX_RAYS_PER_PIXEL_SIDE, math.ceil(cameras.pixel_footprint(bounds.centre.cpu()) / cell))
    fine = cameras.rescale(times)
    seen = torch.zeros(n**3, dtype=torch.bool, device=system.device)
    for view in track_progress(range(len(fine)), len(fine), "views"):
        rays = fine.generate_view_rays(view)
        for start in range(0, len(rays), system.chunk_rays):
            chunk = rays[start : start + system.chunk_rays].to(system.device)
            samples = system.sampler(chunk, system.field.density)
            positions = samples.positions(chunk)
            opacity = 1 - torch.exp(-system.field.density(positions) * samples.dt)
            x, y, z = (bounds.to_unit(positions[opacity > MIN_OPACITY]) * n).long().clamp(0, n - 1).unbind(1)
            seen[(x * n + y) * n + z] = True
    return seen.view(n, n, n)


def prune_to_cells(system: System, cells: CellMask | None) -> System:
    """A copy of a system with only what some cells need, on the CPU, to be encoded; the system itself for None."""
    if cells is None:
        return system
    part: Any = copy.deepcopy(system).cpu()
    part.field.prune(cells.cpu())
    part.sampler.import_state({"grid.occupied": cells.cpu().flatten()})
    return part


@dataclass(frozen=True)
class CompactFile:
    """A compact file, and its quality."""

    content: bytes
    precision: str
    psnr: float
    """dB on the held-out views."""
    psnr_before: float
    """The same of the system it was made from."""

    @property
    def psnr_drop(self) -> float:
        """dB lost."""
        return self.psnr_before - self.psnr


def measure_held_out_psnr(system: System, data: DataModule, views: Sequence[int] | None = None) -> float:
    """Mean dB over held-out views that have a figure, nan where none has; over all of them for None."""
    chosen = range(data.num_held_out_views) if views is None else views
    results = system.evaluate_held_out(data, track_progress(chosen, len(chosen), "held-out views"))
    finite = [result.psnr for result in results if math.isfinite(result.psnr)]  # of some, no pixel may be known
    return fmean(finite) if finite else math.nan


def subsample_cameras(data: DataModule, max_views: int = MAX_VISIBILITY_VIEWS) -> Cameras:
    """Those of training views spread over all."""
    cameras = data.scene.train.cameras
    return cameras[torch.tensor(subsample(len(cameras), max_views))]


def compress_system(
    system: Any,
    data: DataModule,
    config: dict[str, Any],
    max_psnr_drop: float,
    seen: CellMask | None = None,
) -> CompactFile:
    """Encodes a system in the fewest bytes within the allowed loss: what its photos' cameras see, or everything.

    Args:
        system: trained.
        data: of its run.
        config: of its run, as plain values.
        most_loss: dB on held-out views.
        seen: the occupied cells that its photos' cameras see, where they are known.

    Raises:
        InputError: where every precision loses more.
    """
    before = measure_held_out_psnr(system, data)
    if seen is None and data.is_posed:
        seen = find_seen_cells(system, subsample_cameras(data))
    occupied = get_occupied_cells(system)
    alike = seen is None or occupied is None or torch.equal(seen, occupied)
    confined = [prune_to_cells(system, cells) for cells in ([seen] if alike else [seen, occupied])]
    scene = scene_to_dict(data)
    tried: list[CompactFile] = []
    for one in PRECISIONS:
        for part in confined:  # few photos do not see all that held-out views do
            content = encode(part, one, config, scene)
            small = decode(content, "compact", system.device).system
            tried.append(CompactFile(content, one, measure_held_out_psnr(small, data), before))
            if tried[-1].psnr_drop <= max_psnr_drop:
                return tried[-1]
    best = min(tried, key=lambda compact: compact.psnr_drop)
    advice = f"allow it with --max-psnr-drop {best.psnr_drop + 0.005:.2f}"
    raise InputError(
        "export", "max_psnr_drop", f"{best.psnr_drop:.2f} dB lost", f"at most {max_psnr_drop:g} dB", advice
    )
