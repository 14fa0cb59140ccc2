"""Quality of each view, as a table and as plain values."""

from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from rich.table import Table

from nerf_lightning.utils.files import known
from nerf_lightning.utils.machine import describe_machine


@dataclass(frozen=True)
class ViewMetrics:
    """How good one view is."""

    view: int
    psnr: float
    ssim: float
    """nan for views smaller than its window."""
    lpips: float | None
    seconds: float
    """Of rendering."""


def format_table(metrics: list[ViewMetrics]) -> Table:
    """All views, the worst marked, and their means."""
    lowest = min(metrics, key=lambda one: one.psnr)
    drawn = Table("view", "PSNR, dB", "SSIM", "LPIPS", "seconds", box=None)
    for one in metrics:
        mark = " <- worst" if one is lowest and len(metrics) > 1 else ""
        drawn.add_row(*_format_row(str(one.view), vars(one), mark))
    drawn.add_row(*_format_row("mean", average(metrics)))
    return drawn


def _format_row(name: str, figures: dict[str, float | None], mark: str = "") -> tuple[str, ...]:
    digits = {"psnr": 2, "ssim": 4, "lpips": 4, "seconds": 3}
    *cells, seconds = ("-" if known(figures[key]) is None else f"{figures[key]:.{n}f}" for key, n in digits.items())
    return name, *cells, seconds + mark


def average(metrics: list[ViewMetrics]) -> dict[str, float | None]:
    """The mean of each figure over the views; None where a view lacks it."""
    means: dict[str, float | None] = {}
    for name in ("psnr", "ssim", "lpips", "seconds"):
        values = [value for one in metrics if (value := known(getattr(one, name))) is not None]
        means[name] = fmean(values) if len(values) == len(metrics) else None
    return means


def to_json(
    metrics: list[ViewMetrics], source: Path, scene: dict[str, object], device: torch.device
) -> dict[str, object]:
    """The evaluation as plain values."""
    views = [known(vars(one)) for one in metrics]
    machine = {"device": str(device), "machine": describe_machine(device)}
    return {"run": str(source), "scene": scene, **machine, "mean": average(metrics), "views": views}
