"""The evaluate verb's work: every held-out view rendered and judged, a table, and pictures of the worst."""

import math
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from nerf_lightning.drawing.panels import result_panel, write_png
from nerf_lightning.evaluate.perceptual import perceptual_distance
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.open import beside, open_run
from nerf_lightning.system import ViewResult
from nerf_lightning.utils.device import the_device
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.machine import describe_machine, device_in_words
from nerf_lightning.utils.progress import tracked


@dataclass(frozen=True)
class Judged:
    """What a view came to."""

    view: int
    psnr: float
    ssim: float
    """nan for views smaller than its window."""
    lpips: float | None
    seconds: float
    """Of rendering."""


def evaluate(run: str, output: str | None, worst: int, device: str, photos: str | None) -> None:
    """Judges a run on held-out views, those of another file where one is given.

    Args:
        run: its folder, or its compact file.
        output: folder for the results; None puts them into `evaluation/` beside the run.
        worst: how many of the worst views are pictured.
        device: that renders, see `the_device`.
        photos: another file or folder of photos.

    Raises:
        InputError: where the device, the run or the photos are no good, or do not fit each other.
    """
    where = the_device(device)
    source = Path(run).expanduser()
    found = open_run(source, where)
    data = data_again(found.cfg, found.scene, photos)
    folder = beside(source) / "evaluation" if output is None else Path(output).expanduser()
    first = data.held_out(0)
    distance, why = perceptual_distance(first.width, first.height)
    judged: list[Judged] = []
    kept: dict[int, ViewResult] = {}
    views = tracked(range(data.held_out_views), data.held_out_views, "held-out views")
    for view, result in enumerate(found.system.evaluate_held_out(data, views)):
        lpips = None if distance is None else distance(result.rgb, result.truth)
        judged.append(Judged(view, result.psnr, result.ssim, lpips, result.seconds))
        kept[view] = result
        if len(kept) > worst:
            del kept[max(kept, key=lambda one: kept[one].psnr)]
    write_json(folder / "views.json", as_json(judged, source, data.scene.describe(), where))
    poorest = sorted(kept, key=lambda one: kept[one].psnr)
    write_png(
        folder / "worst.png", np.concatenate([result_panel(kept[one], captioned(judged[one])) for one in poorest])
    )
    Console(highlight=False, soft_wrap=True).print(table(judged))
    mean = fmean(one.psnr for one in judged)
    over = f"{len(judged)} held-out views on {device_in_words(where)}"
    print(f"{data.scene.name}: {mean:.2f} dB over {over}; {folder}/worst.png, views.json")
    if why:
        print(f"no LPIPS: {why}")


def captioned(one: Judged) -> str:
    """A view's figures in one line."""
    return f"view {one.view}, {one.psnr:.2f} dB, SSIM {one.ssim:.3f}"


def table(judged: list[Judged]) -> Table:
    """All views, the worst marked, and their means."""
    lowest = min(judged, key=lambda one: one.psnr)
    drawn = Table("view", "PSNR, dB", "SSIM", "LPIPS", "seconds", box=None)
    for one in judged:
        mark = " <- worst" if one is lowest and len(judged) > 1 else ""
        drawn.add_row(
            str(one.view), f"{one.psnr:.2f}", _figure(one.ssim), _figure(one.lpips), f"{one.seconds:.3f}{mark}"
        )
    means = averages(judged)
    drawn.add_row(
        "mean", f"{means['psnr']:.2f}", _figure(means["ssim"]), _figure(means["lpips"]), f"{means['seconds']:.3f}"
    )
    return drawn


def averages(judged: list[Judged]) -> dict[str, float | None]:
    """The mean of each figure over the views; None where it could not be told."""
    means: dict[str, float | None] = {}
    for name in ("psnr", "ssim", "lpips", "seconds"):
        values = [getattr(one, name) for one in judged]
        whole = all(value is not None and math.isfinite(value) for value in values)
        means[name] = fmean(values) if whole else None
    return means


def as_json(judged: list[Judged], source: Path, scene: dict[str, object], device: torch.device) -> dict[str, object]:
    """The evaluation as plain values."""
    views = [{key: _plain(value) for key, value in vars(one).items()} for one in judged]
    taken = {"device": str(device), "machine": describe_machine(device)}
    return {"run": str(source), "scene": scene, **taken, "mean": averages(judged), "views": views}


def _plain(value: float | None) -> float | None:
    return None if value is None or not math.isfinite(value) else value


def _figure(value: float | None) -> str:
    return "-" if _plain(value) is None else f"{value:.4f}"
