"""Final report of a run."""

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

from lightning.pytorch.loggers import Logger, TensorBoardLogger

from nerf_lightning.dataset import DataModule
from nerf_lightning.refine import format_report, summarize_corrections
from nerf_lightning.runs.scene_file import save_scene
from nerf_lightning.system import System
from nerf_lightning.utils.machine import MAX_BACKGROUND_LOAD, background_load
from nerf_lightning.utils.text import join_truncated

MAX_NAMED_PHOTOS = 10
"""Outlier photos printed; results.json lists all."""


def report_photos(system: System, data: DataModule, results: dict[str, Any], folder: Path) -> None:
    """Saves refined cameras, and prints corrections and outlier photos."""
    if system.corrections is not None and system.corrections.is_finite:
        if "poses" in system.corrections.enabled_at:
            cameras = system.corrections.poses.refine_cameras(data.scene.train.cameras)
            save_scene(data, folder, cameras, summarize_corrections(system.corrections)["focal_factor"])
        psnr = results["psnr_aligned"]
        aligned = "" if psnr is None else f"; {psnr:.2f} dB held out with aligned cameras"
        print(format_report(system.corrections) + aligned)
    if results["misfits"]:
        photos = [f"{photo['photo']} ({photo['psnr']:.1f} dB)" for photo in results["misfits"]]
        names = join_truncated(photos, MAX_NAMED_PHOTOS)
        print(f"training photos that do not fit the others (a wrong pose, or something moved): {names}")


def report_results(results: dict, folder: Path, logger: Logger | None) -> None:
    for restart in results["recoveries"]:
        print(f"recovery: at step {restart['step']}: {restart['cause']}; {restart['action']}")
    scene, seconds = results["scene"]["name"], results["train_seconds"]
    quality = "no PSNR" if results["psnr"] is None else f"{results['psnr']:.2f} dB"
    quality += " held out"
    if (test := results["test"]) is not None and test["psnr"] is not None:
        total = "" if test["views"] == test["views_in_split"] else f" of {test['views_in_split']}"
        quality += f" (val), {test['psnr']:.2f} dB on {test['views']}{total} test views,"
    print(f"{scene}: {quality} after {seconds:.0f} s of training ({results['status']})")
    if (results["rows_measured"] or 1.0) < 1.0:
        rows = f"{results['rows_measured']:.0%} of the rows of each held-out photo, to take no longer than training"
        print(f"measured on {rows}; nerf_lightning evaluate {shlex.quote(str(folder))} measures all")
    if results["diagnosis"]:
        print(results["diagnosis"])
    load = background_load(results)
    if load is not None and load > MAX_BACKGROUND_LOAD:
        print(f"the machine was busy: other processes took {load:.0%} of this run's threads")
    with suppress(ValueError):  # a folder elsewhere is printed with its full path
        folder = folder.relative_to(Path.cwd())
    has_curves = isinstance(logger, TensorBoardLogger)
    print(f"everything is in {folder}" + (f"; curves: tensorboard --logdir {folder.parent}" if has_curves else ""))
