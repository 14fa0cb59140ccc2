"""The smallest compact file of a run that still shows what the run shows."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from nerf_lightning.cameras import Rays
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.evenly import evenly
from nerf_lightning.export.compact import decode, encode
from nerf_lightning.export.reach import confine, reached_cells
from nerf_lightning.progress import tracked
from nerf_lightning.run_folder import scene_content
from nerf_lightning.system import NeRF3D, System

MOST_VIEWS = 60
"""Training views whose light is followed to learn which cells matter."""
PRECISIONS = ("byte", "half")
"""Smallest first."""


@dataclass(frozen=True)
class Compact:
    """A compact file, and what it costs."""

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


def held_out_psnr(system: System, data: RayDataModule | PixelDataModule, views: Sequence[int] | None = None) -> float:
    """Mean dB over held-out views; over all of them for None."""
    chosen = range(data.held_out_views) if views is None else views
    return fmean(system.evaluate(data.held_out(view)).psnr for view in tracked(chosen, len(chosen), "held-out views"))


def training_rays(data: RayDataModule) -> Iterator[Rays]:
    """The rays of training views, spread over all."""
    cameras = data.scene.train.cameras
    for view in evenly(len(cameras), MOST_VIEWS):
        yield cameras.view_rays(view)


def smallest(
    system: System,
    data: RayDataModule | PixelDataModule,
    config: dict[str, Any],
    most_loss: float,
    precision: str | None = None,
    views: Sequence[int] | None = None,
) -> Compact:
    """Confines a system to what its photos' cameras see, and codes it in the fewest bytes that lose no more than allowed.

    Args:
        system: trained. It is left confined.
        data: of its run.
        config: of its run, as plain values.
        most_loss: dB on held-out views.
        precision: "byte" or "half"; None takes the smaller one that is allowed.
        views: held-out views to judge by; None takes all.

    Raises:
        InputError: where every precision asked for loses more.
    """
    before = held_out_psnr(system, data, views)
    if isinstance(system, NeRF3D) and isinstance(data, RayDataModule):
        reached = reached_cells(system, training_rays(data))
        if reached is not None:
            confine(system, reached)
    scene = scene_content(data)
    tried: list[Compact] = []
    for one in PRECISIONS if precision is None else (precision,):
        content = encode(system, one, config, scene)
        small = decode(content, "compact").system.to(system.device)
        tried.append(Compact(content, one, held_out_psnr(small, data, views), before))
        if tried[-1].loss <= most_loss:
            return tried[-1]
    best = min(tried, key=lambda compact: compact.loss)
    found = f"{best.loss:.2f} dB lost with precision={best.precision}"
    advice = f"allow it with loss={best.loss + 0.005:.2f}" + (", or precision=half" if precision == "byte" else "")
    raise InputError("export", "loss", found, f"at most {most_loss:g} dB", advice)
