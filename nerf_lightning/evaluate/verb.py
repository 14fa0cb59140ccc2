"""The evaluate verb: every held-out view rendered and measured, a table, and pictures of the worst."""

from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import torch
from rich.console import Console
from rich.table import Table

from nerf_lightning.dataset import RayDataModule
from nerf_lightning.drawing.panels import result_panel, stacked, write_png
from nerf_lightning.errors import InputError
from nerf_lightning.evaluate.perceptual import SMALLEST, TOO_SMALL, perceptual_distance
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.open import beside, open_run
from nerf_lightning.system import ViewResult
from nerf_lightning.utils.device import the_device
from nerf_lightning.utils.files import known, output_path, user_path, write_json
from nerf_lightning.utils.machine import describe_machine, device_in_words
from nerf_lightning.utils.progress import tracked


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


def evaluate(run: str, output: str | None, worst: int, device: str, split: str, photos: str | None) -> None:
    """Measures a run on held-out views, those of another file where one is given.

    Args:
        run: its folder, or its compact file.
        output: folder for the results; None puts them into `evaluation/` beside the run.
        worst: how many of the worst views are pictured.
        device: see `the_device`.
        split: val or test.
        photos: another file or folder of photos.

    Raises:
        InputError: where the device, the run or the photos are no good, or do not fit each other, or have no such split.
    """
    where = the_device(device)
    source = user_path(run)
    found = open_run(source, where)
    data = data_again(found.cfg, found.scene, photos)
    if split not in ("val", "test"):
        raise InputError("config", "split", split, "val or test")
    if split == "test":
        if not isinstance(data, RayDataModule) or data.scene.test is None:
            raise InputError("config", "split", "test", "val: these photos have no test split")
        data.scene = replace(data.scene, val=data.scene.test)
    folder = beside(source) / "evaluation" if output is None else output_path(output)
    distance, why = perceptual_distance()
    metrics: list[ViewMetrics] = []
    kept: dict[int, ViewResult] = {}
    views = tracked(range(data.held_out_views), data.held_out_views, "held-out views")
    for view, result in enumerate(found.system.evaluate_held_out(data, views)):
        why = TOO_SMALL if min(result.rgb.shape[:2]) < SMALLEST else why
        lpips = None if distance is None else distance(result.rgb, result.comparable)
        metrics.append(ViewMetrics(view, result.psnr, result.ssim, lpips, result.seconds))
        kept[view] = result
        if len(kept) > worst:
            del kept[max(kept, key=lambda one: kept[one].psnr)]
    write_json(folder / "views.json", as_json(metrics, source, data.scene.describe(), where))
    panels = []
    for view in sorted(kept, key=lambda one: kept[one].psnr):
        caption = f"view {view}, {metrics[view].psnr:.2f} dB, SSIM {metrics[view].ssim:.3f}"
        panels.append(result_panel(kept[view], caption))
    write_png(folder / "worst.png", stacked(panels))
    Console(highlight=False, soft_wrap=True).print(table(metrics))
    mean = fmean(one.psnr for one in metrics)
    over = f"{len(metrics)} {'test' if split == 'test' else 'held-out'} views on {device_in_words(where)}"
    print(f"{data.scene.name}: {mean:.2f} dB over {over}; {folder}/worst.png, views.json")
    if why:
        print(f"no LPIPS: {why}")


def table(metrics: list[ViewMetrics]) -> Table:
    """All views, the worst marked, and their means."""
    lowest = min(metrics, key=lambda one: one.psnr)
    drawn = Table("view", "PSNR, dB", "SSIM", "LPIPS", "seconds", box=None)
    for one in metrics:
        mark = " <- worst" if one is lowest and len(metrics) > 1 else ""
        drawn.add_row(*_row(str(one.view), vars(one), mark))
    drawn.add_row(*_row("mean", averages(metrics)))
    return drawn


def _row(name: str, figures: dict[str, float | None], mark: str = "") -> tuple[str, ...]:
    digits = {"psnr": 2, "ssim": 4, "lpips": 4, "seconds": 3}
    *cells, seconds = ("-" if known(figures[key]) is None else f"{figures[key]:.{n}f}" for key, n in digits.items())
    return name, *cells, seconds + mark


def averages(metrics: list[ViewMetrics]) -> dict[str, float | None]:
    """The mean of each figure over the views; None where a view lacks it."""
    means: dict[str, float | None] = {}
    for name in ("psnr", "ssim", "lpips", "seconds"):
        values = [value for one in metrics if (value := known(getattr(one, name))) is not None]
        means[name] = fmean(values) if len(values) == len(metrics) else None
    return means


def as_json(
    metrics: list[ViewMetrics], source: Path, scene: dict[str, object], device: torch.device
) -> dict[str, object]:
    """The evaluation as plain values."""
    views = [known(vars(one)) for one in metrics]
    machine = {"device": str(device), "machine": describe_machine(device)}
    return {"run": str(source), "scene": scene, **machine, "mean": averages(metrics), "views": views}
