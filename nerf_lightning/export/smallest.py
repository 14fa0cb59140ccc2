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
from nerf_lightning.model.layers.pruning import widened
from nerf_lightning.runs.compact import decode, encode
from nerf_lightning.runs.scene_file import scene_content
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.text import subsample

MOST_VIEWS = 60
"""Training views whose rays show which cells matter."""
PRECISIONS = ("byte", "half")
"""Smallest first."""
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
    part.sampler.import_state({"grid.occupied": cells.cpu().flatten()})
    return part


@dataclass(frozen=True)
class Compact:
    """A compact file, and its quality."""

    content: bytes
    precision: str
    psnr: float
    """dB on the held-out views."""
    before: float
    """The same of the system it was made from."""

    @property
    def loss(self) -> float:
        """dB lost."""
        return self.before - self.psnr


def held_out_psnr(system: System, data: DataModule, views: Sequence[int] | None = None) -> float:
    """Mean dB over held-out views that have a figure, nan where none has; over all of them for None."""
    chosen = range(data.held_out_views) if views is None else views
    results = system.evaluate_held_out(data, tracked(chosen, len(chosen), "held-out views"))
    finite = [result.psnr for result in results if math.isfinite(result.psnr)]  # of some, no pixel may be known
    return fmean(finite) if finite else math.nan


def some_cameras(data: DataModule, most: int = MOST_VIEWS) -> Cameras:
    """Those of training views spread over all."""
    cameras = data.scene.train.cameras
    return cameras[torch.tensor(subsample(len(cameras), most))]


def smallest(
    system: Any,
    data: DataModule,
    config: dict[str, Any],
    most_loss: float,
    seen: Cells | None = None,
) -> Compact:
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
    before = held_out_psnr(system, data)
    if seen is None and data.has_cameras:
        seen = seen_cells(system, some_cameras(data))
    occupied = occupied_cells(system)
    alike = seen is None or occupied is None or torch.equal(seen, occupied)
    confined = [confined_to(system, cells) for cells in ([seen] if alike else [seen, occupied])]
    scene = scene_content(data)
    tried: list[Compact] = []
    for one in PRECISIONS:
        for part in confined:  # few photos do not see all that held-out views do
            content = encode(part, one, config, scene)
            small = decode(content, "compact", system.device).system
            tried.append(Compact(content, one, held_out_psnr(small, data), before))
            if tried[-1].loss <= most_loss:
                return tried[-1]
    best = min(tried, key=lambda compact: compact.loss)
    advice = f"allow it with --loss-db {best.loss + 0.005:.2f}"
    raise InputError("export", "loss_db", f"{best.loss:.2f} dB lost", f"at most {most_loss:g} dB", advice)
