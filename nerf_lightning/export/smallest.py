"""The smallest compact file of a run that still shows what the run shows."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

import torch

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset import DataModule
from nerf_lightning.errors import InputError
from nerf_lightning.export.reach import Cells, confined_to, occupied_cells, seen_cells
from nerf_lightning.runs.compact import decode, encode
from nerf_lightning.runs.scene_file import scene_content
from nerf_lightning.system import System
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.text import subsample

MOST_VIEWS = 60
"""Training views whose rays show which cells matter."""
PRECISIONS = ("byte", "half")
"""Smallest first."""


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
    precision: str | None = None,
    seen: Cells | None = None,
) -> Compact:
    """Encodes a system in the fewest bytes within the allowed loss: what its photos' cameras see, or everything.

    Args:
        system: trained.
        data: of its run.
        config: of its run, as plain values.
        most_loss: dB on held-out views.
        precision: "byte" or "half"; None takes the smaller one that is allowed.
        seen: the occupied cells that its photos' cameras see, where they are known.

    Raises:
        InputError: where every precision asked for loses more.
    """
    before = held_out_psnr(system, data)
    if seen is None and data.has_cameras:
        seen = seen_cells(system, some_cameras(data))
    occupied = occupied_cells(system)
    alike = seen is None or occupied is None or torch.equal(seen, occupied)
    confined = [confined_to(system, cells) for cells in ([seen] if alike else [seen, occupied])]
    scene = scene_content(data)
    tried: list[Compact] = []
    for one in PRECISIONS if precision is None else (precision,):
        for part in confined:  # few photos do not see all that held-out views do
            content = encode(part, one, config, scene)
            small = decode(content, "compact", system.device).system
            tried.append(Compact(content, one, held_out_psnr(small, data), before))
            if tried[-1].loss <= most_loss:
                return tried[-1]
    best = min(tried, key=lambda compact: compact.loss)
    found = f"{best.loss:.2f} dB lost with --precision {best.precision}"
    advice = f"allow it with --loss-db {best.loss + 0.005:.2f}" + (
        ", or --precision half" if precision == "byte" else ""
    )
    raise InputError("export", "loss_db", found, f"at most {most_loss:g} dB", advice)
