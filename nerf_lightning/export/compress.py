"""Compression: pruning to visible cells and quantization, within an allowed PSNR drop."""

import copy
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays
from nerf_lightning.dataset import DataModule
from nerf_lightning.dataset.pixel_subset import make_subset
from nerf_lightning.errors import InputError
from nerf_lightning.kernels import cell_index
from nerf_lightning.model.layers.grid_masks import dilate
from nerf_lightning.runs.compact import decode_run, encode_system
from nerf_lightning.runs.scene_file import scene_to_dict
from nerf_lightning.sampler import OccupancySampler, Samples
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.text import subsample

MAX_VISIBILITY_VIEWS = 60
"""Number of training views used to determine visible cells."""
PRECISIONS = ("byte", "half")
"""Smallest first; "coarse" precedes them for baked systems."""
MAX_BAKED_PIXELS = 50_000
"""Held-out pixels on which a baked system is compared with the original."""
MIN_OPACITY = 1e-3
"""Opacity of a sample below which it is empty."""
MAX_RAYS_PER_PIXEL_SIDE = 8
"""Maximum supersampling per pixel axis."""

CellMask = Bool[Tensor, "G G G"]
"""Mask over the cells of an occupancy grid."""


def get_occupied_cells(system: System) -> CellMask | None:
    """Occupied cells of the sampler's grid; None for a sampler without one."""
    sampler = system.exportable_modules.get("sampler")
    return sampler.grid.occupied.view(*[sampler.grid.resolution] * 3) if isinstance(sampler, OccupancySampler) else None


def find_seen_cells(system: NeRF3D, cameras: Cameras) -> CellMask | None:
    """Occupied cells that are visible to the cameras, and their neighbors; None without an occupancy grid."""
    occupied = get_occupied_cells(system)
    if occupied is None:
        return None
    return dilate(find_visible_cells(system, cameras, len(occupied))) & occupied


def sample_views(system: NeRF3D, cameras: Cameras) -> Iterator[tuple[Rays, Samples, Float[Tensor, "N"]]]:
    """Rays of all views in chunks, with their samples and the density there."""
    for view in track_progress(range(len(cameras)), len(cameras), "views"):
        all_rays = cameras.generate_view_rays(view)
        for start in range(0, len(all_rays), system.chunk_rays):
            rays = all_rays[start : start + system.chunk_rays].to(system.device)
            samples = system.sampler(rays, system.field.density)
            yield rays, samples, system.field.density(samples.positions(rays))


@torch.no_grad()
def find_visible_cells(system: NeRF3D, cameras: Cameras, n: int) -> CellMask:
    """Cells of an n^3 grid over the bounds in which any camera sees content; ray spacing matches the cells."""
    bounds = system.field.bounds
    cell = (4 if bounds.unbounded else 2) * bounds.max_half_size / n
    factor = min(MAX_RAYS_PER_PIXEL_SIDE, math.ceil(cameras.pixel_footprint(bounds.content_center.cpu()) / cell))
    seen = torch.zeros(n**3, dtype=torch.bool, device=system.device)
    for rays, samples, density in sample_views(system, cameras.rescale(factor)):
        is_content = 1 - torch.exp(-density * samples.dt) > MIN_OPACITY
        seen[cell_index(bounds.to_unit(samples.positions(rays)[is_content]), n)] = True
    return seen.view(n, n, n)


def prune_to_cells(system: System, cells: CellMask | None) -> System:
    """A CPU copy of a system with only the parameters that `cells` need; the system itself for None."""
    if cells is None:
        return system
    pruned: Any = copy.deepcopy(system).cpu()
    pruned.field.prune(cells.cpu())
    pruned.sampler.import_state({"grid.occupied": cells.cpu().flatten()})
    return pruned


@dataclass(frozen=True)
class CompactFile:
    """Content and quality of a compact file."""

    content: bytes
    precision: str
    psnr: float
    """Held-out PSNR, dB."""
    psnr_before: float
    """Held-out PSNR of the original system, dB."""

    @property
    def psnr_drop(self) -> float:
        return self.psnr_before - self.psnr


def measure_held_out_psnr(
    system: System, data: DataModule, views: Sequence[int] | None = None, max_pixels: float = math.inf
) -> float:
    """Mean PSNR over held-out views with known pixels, dB (all views for None); NaN if there is none.

    Args:
        system: trained.
        data: of its run.
        views: indices of held-out views.
        max_pixels: number of pixels over all views, of which a subset is taken.
    """
    chosen = range(data.num_held_out_views) if views is None else views
    subset = make_subset(sum(map(data.count_held_out_pixels, chosen)), max_pixels)
    results = system.evaluate_held_out(data, track_progress(chosen, len(chosen), "held-out views"), subset)
    finite = [result.psnr for result in results if math.isfinite(result.psnr)]  # fully masked views have none
    return fmean(finite) if finite else math.nan


def subsample_cameras(data: DataModule, max_views: int = MAX_VISIBILITY_VIEWS) -> Cameras:
    """Cameras of evenly spaced training views."""
    cameras = data.scene.train.cameras
    return cameras[torch.tensor(subsample(len(cameras), max_views))]


def compress_system(
    system: Any, data: DataModule, config: dict[str, Any], max_psnr_drop: float, is_baked: bool = False
) -> CompactFile:
    """Encodes a system in the fewest bytes within `max_psnr_drop`: first only visible cells, then all.

    Args:
        system: trained.
        data: of its run.
        config: of its run, as plain values.
        max_psnr_drop: on held-out views, dB.
        is_baked: whether `bake_system` has removed what the training cameras do not see.

    Raises:
        InputError: every precision loses more.
    """
    precisions, pixels = (("coarse", *PRECISIONS), MAX_BAKED_PIXELS) if is_baked else (PRECISIONS, math.inf)
    before = measure_held_out_psnr(system, data, max_pixels=pixels)
    seen = None if is_baked or not data.is_posed else find_seen_cells(system, subsample_cameras(data))
    occupied = get_occupied_cells(system)
    same_cells = seen is None or occupied is None or torch.equal(seen, occupied)
    candidates = [prune_to_cells(system, cells) for cells in ([seen] if same_cells else [seen, occupied])]
    scene = scene_to_dict(data)
    attempts: list[CompactFile] = []
    for precision in precisions:
        for part in candidates:  # held-out views may see more than few photos do
            content = encode_system(part, precision, config, scene)
            small = decode_run(content, "compact", system.device).system
            psnr = measure_held_out_psnr(small, data, max_pixels=pixels)
            attempts.append(CompactFile(content, precision, psnr, before))
            if attempts[-1].psnr_drop <= max_psnr_drop:
                return attempts[-1]
    best = min(attempts, key=lambda compact: compact.psnr_drop)
    hint = f"allow it with --max-psnr-drop {best.psnr_drop + 0.005:.2f}"
    raise InputError("export", "max_psnr_drop", f"{best.psnr_drop:.2f} dB lost", f"at most {max_psnr_drop:g} dB", hint)
