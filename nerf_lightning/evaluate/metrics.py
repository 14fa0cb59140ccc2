"""PSNR, SSIM and LPIPS of each view. LPIPS needs local weights: nothing is downloaded."""

import importlib
import math
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.system import System, ViewResult
from nerf_lightning.utils.files import nan_to_none
from nerf_lightning.utils.machine import describe_machine
from nerf_lightning.utils.progress import track_progress

TABLE_DECIMALS = {"psnr": 2, "ssim": 4, "lpips": 4, "seconds": 3}
"""Decimals of each metric. SSIM is NaN for views smaller than its window, LPIPS where it is unavailable."""
ALEXNET_WEIGHTS = "alexnet-owt-7be5be79.pth"
"""torchvision's file in torch.hub's folder."""
MIN_LPIPS_SIDE = 64
"""Minimum side of an image for AlexNet, pixels."""


def measure_views(
    system: System, data: RayDataModule | PixelDataModule, worst: int
) -> tuple[pd.DataFrame, dict[int, ViewResult]]:
    """Metrics of all held-out views, and results of the `worst` worst ones by view index."""
    lpips, rows = load_lpips(), []
    results: dict[int, ViewResult] = {}
    views = track_progress(range(data.num_held_out_views), data.num_held_out_views, "held-out views")
    for view, result in enumerate(system.evaluate_held_out(data, views)):
        rows.append((result.psnr, result.ssim, lpips(result.rgb, result.masked_truth), result.seconds))
        results[view] = result
        if len(results) > worst:
            del results[max(results, key=lambda view: results[view].psnr)]
    return pd.DataFrame(rows, columns=list(TABLE_DECIMALS), dtype=float), results


def load_lpips() -> Callable[[Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]], float]:
    """Loads LPIPS (Zhang et al. 2018) with AlexNet, for two images in [0, 1]; lower is better, NaN for images too small.

    Without torchvision or weights it returns NaN, and one line is printed.
    """
    weights, reason = Path(torch.hub.get_dir()) / "checkpoints" / ALEXNET_WEIGHTS, ""
    try:
        importlib.import_module("torchvision")
        reason = "" if weights.exists() else f"{weights} does not exist"
    except ImportError:
        reason = "torchvision is not installed: pip install 'nerf_lightning[lpips]'"
    if reason:
        print(f"no LPIPS: {reason}")

    def lpips(image: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"]) -> float:
        if reason or min(image.shape[:2]) < MIN_LPIPS_SIDE:
            return math.nan
        first, second = (x.permute(2, 0, 1)[None] for x in (image, truth))
        return float(learned_perceptual_image_patch_similarity(first, second, net_type="alex", normalize=True))

    return lpips


def format_table(views: pd.DataFrame) -> str:
    """Formats the metrics of all views and their means, with the worst view marked."""
    rows = pd.concat([views, views.mean(skipna=False).to_frame("mean").T])
    table = pd.DataFrame({name: rows[name].map(f"{{:.{digits}f}}".format) for name, digits in TABLE_DECIMALS.items()})
    worst = views["psnr"] == views["psnr"].min()
    table[""] = ["<- worst" if mark and len(views) > 1 else "" for mark in (*worst, False)]
    names = {"psnr": "PSNR, dB", "ssim": "SSIM", "lpips": "LPIPS"}
    return table.rename(columns=names).replace("nan", "-").to_string()


def to_json(views: pd.DataFrame, source: Path, scene: dict[str, object], device: torch.device) -> dict[str, object]:
    """The evaluation as plain values; the mean of a metric missing in any view is None."""
    machine = {"device": str(device), "machine": describe_machine(device)}
    records = views.reset_index(names="view").to_dict("records")
    figures = {"mean": nan_to_none(views.mean(skipna=False).to_dict()), "views": nan_to_none(records)}
    return {"run": str(source), "scene": scene, **machine, **figures}
