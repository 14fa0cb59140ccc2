"""What a run says when it has ended."""

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
"""Photos that do not fit which are printed; all stand in results.json."""


def report_photos(system: System, data: DataModule, results: dict[str, Any], folder: Path) -> None:
    """Saves corrected cameras, and prints what training has found out about the photos."""
    if system.corrections is not None and system.corrections.is_finite:
        if "poses" in system.corrections.enabled_at:
            cameras = system.corrections.poses.refine_cameras(data.scene.train.cameras)
            save_scene(data, folder, cameras, summarize_corrections(system.corrections)["focal_factor"])
        found = results["psnr_aligned"]
        aligned = "" if found is None else f"; {found:.2f} dB held out with held-out photos corrected too"
        print(format_report(system.corrections) + aligned)
    if results["misfits"]:
        named = join_truncated(
            [f"{one['photo']} ({one['psnr']:.1f} dB)" for one in results["misfits"]], MAX_NAMED_PHOTOS
        )
        print(f"training photos that do not fit the others (a wrong pose, or something moved): {named}")


def report_results(results: dict, folder: Path, logger: Logger | None) -> None:
    """Prints the outcome."""
    for one in results["recoveries"]:
        print(f"recovery: at step {one['step']}: {one['cause']}; {one['action']}")
    scene, seconds = results["scene"]["name"], results["train_seconds"]
    quality = "no PSNR" if results["psnr"] is None else f"{results['psnr']:.2f} dB"
    quality += " held out"
    if (test := results["test"]) is not None and test["psnr"] is not None:
        of = "" if test["views"] == test["views_in_split"] else f" of {test['views_in_split']}"
        quality += f" (val), {test['psnr']:.2f} dB on {test['views']}{of} test views,"
    print(f"{scene}: {quality} after {seconds:.0f} s of training ({results['status']})")
    if (results["rows_measured"] or 1.0) < 1.0:
        share = f"{results['rows_measured']:.0%} of the rows of each held-out photo, to take no longer than training"
        print(f"measured on {share}; nerf_lightning evaluate {shlex.quote(str(folder))} measures all")
    if results["diagnosis"]:
        print(results["diagnosis"])
    crowded = background_load(results)
    if crowded is not None and crowded > MAX_BACKGROUND_LOAD:
        print(f"the machine was busy with something else, which took {crowded:.0%} of this run's threads")
    with suppress(ValueError):  # a folder elsewhere is printed with its full path
        folder = folder.relative_to(Path.cwd())
    shown = isinstance(logger, TensorBoardLogger)
    print(f"everything is in {folder}" + (f"; curves: tensorboard --logdir {folder.parent}" if shown else ""))
