"""Evaluation: the final metrics of a trained field."""

import math
import sys
from collections.abc import Callable, Sequence
from statistics import fmean, median
from typing import Any

import lightning as L
import psutil
import torch

from nerf_lightning.callbacks.budget import Budget, RenderingCallback
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS_KEY
from nerf_lightning.callbacks.trainer_access import broadcast_from_rank_zero, get_datamodule
from nerf_lightning.dataset import Views
from nerf_lightning.dataset.pixel_subset import ALL_PIXELS, PixelSubset
from nerf_lightning.dataset.ray_datamodule import make_view_batch
from nerf_lightning.system import (
    ALIGN_COST_PIXELS,
    System,
    find_outlier_photos,
    measure_aligned_psnr,
    measure_photo_psnr,
)
from nerf_lightning.utils.text import subsample

RESULT_KEYS = (
    *("psnr", "ssim", "psnr_worst_view", "psnr_aligned", "rows_measured", "test", "render_seconds_per_view"),
    *("peak_memory_bytes", "misfits"),
)
"""Keys of results.json."""


class Evaluation(RenderingCallback):
    """Measures all held-out views after training, then the test split and the training photos.

    Where time is short (see `RenderingCallback`), held-out views are measured on evenly spaced strips of rows, and fewer views
    of the test split.
    """

    weight = 30.0

    def __init__(self) -> None:
        self.metrics: dict[str, Any] = dict.fromkeys(RESULT_KEYS)
        """For results.json; None if not measured, or not yet."""
        self.view_metrics: list[dict[str, float]] = []
        """PSNR, SSIM, render seconds and constant-color PSNR of each held-out view."""
        self.photo_psnrs: list[float] = []
        """PSNR of the training photos; empty for a picture."""
        self._row_fraction = 1.0  # of each held-out view, measured

    def count_remaining_pixels(self, trainer: L.Trainer) -> float:
        data, test = get_datamodule(trainer), get_datamodule(trainer).scene.test
        remaining = range(len(self.view_metrics), data.num_held_out_views)
        pixels = self._row_fraction * sum(map(data.count_held_out_pixels, remaining))
        if trainer.lightning_module.is_corrected and self.metrics["psnr_aligned"] is None:
            pixels += ALIGN_COST_PIXELS * data.num_held_out_views
        return pixels + (len(test.pixels) if test is not None and self.metrics["test"] is None else 0)

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        data = get_datamodule(trainer)
        pixels = sum(map(data.count_held_out_pixels, range(data.num_held_out_views)))
        fraction = self.compute_affordable_fraction(trainer, pl_module, pixels)
        self._row_fraction = broadcast_from_rank_zero(trainer, fraction)
        data.set_test_subset(PixelSubset(row_fraction=self._row_fraction))

    def on_test_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        count = get_datamodule(trainer).num_held_out_views
        Budget.find(trainer).render_timer.start(f"held-out view {batch_idx + 1} of {count}")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        render_timer = Budget.find(trainer).render_timer
        render_timer.stop()
        render_timer.add_timing(batch.height * batch.width, outputs["seconds"])
        self.view_metrics.append(outputs)

    def on_test_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        data, metrics = get_datamodule(trainer), self.metrics
        data.set_test_subset(ALL_PIXELS)
        metrics |= summarize_views(self.view_metrics)
        metrics["rows_measured"] = round(self._row_fraction, 4)
        metrics["render_seconds_per_view"] = compute_statistic(self.view_metrics, median, "seconds")
        if trainer.logger is not None:
            known = {f"val/{key}": metrics[key] for key in ("psnr", "ssim") if metrics[key] is not None}
            trainer.logger.log_metrics({**known, TRAIN_SECONDS_KEY: Budget.find(trainer).seconds}, trainer.global_step)
        if pl_module.is_corrected:
            fraction = self.compute_affordable_fraction(trainer, pl_module)
            with Budget.find(trainer).render_timer.measure("aligned held-out photos"):
                metrics["psnr_aligned"] = round(fmean(measure_aligned_psnr(pl_module, data.scene.val, fraction)), 4)
        if data.scene.test is not None:
            metrics["test"] = self._measure_test_split(trainer, pl_module, data.scene.test)
        if data.is_posed:
            train = data.scene.train
            self.photo_psnrs = measure_photo_psnr(pl_module, train)
            metrics["misfits"] = [
                {"photo": train.name(i), "number": i, "psnr": round(self.photo_psnrs[i], 2)}
                for i in find_outlier_photos(self.photo_psnrs)
            ]
        metrics["peak_memory_bytes"] = get_peak_memory_bytes(pl_module.device)  # charts take more

    def _measure_test_split(self, trainer: L.Trainer, system: System, views: Views) -> dict[str, Any]:
        """Metrics of as many test views as there is time for."""
        fraction, metrics = self.compute_affordable_fraction(trainer, system), []
        render_timer = Budget.find(trainer).render_timer
        chosen = subsample(len(views), max(1, int(fraction * len(views))))
        for number, view in enumerate(chosen, 1):
            with render_timer.measure(f"test view {number} of {len(chosen)}"):
                (result,) = system.evaluate_views([make_view_batch(views, view)])
                metrics.append({"psnr": result.psnr, "ssim": result.ssim})
            render_timer.add_timing(result.num_pixels, result.seconds)
        return {**summarize_views(metrics), "views": len(metrics), "views_in_split": len(views)}


def summarize_views(views: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Mean PSNR and SSIM over views, and the worst PSNR."""
    return {
        "psnr": compute_statistic(views, fmean, "psnr"),
        "ssim": compute_statistic(views, fmean, "ssim"),
        "psnr_worst_view": compute_statistic(views, min, "psnr"),
    }


def compute_statistic(views: Sequence[dict[str, float]], statistic: Callable[..., float], key: str) -> float | None:
    """Statistic of a metric over the views where it is finite; None if there are none."""
    values = [view[key] for view in views if math.isfinite(view[key])]
    return round(statistic(values), 4) if values else None


def get_peak_memory_bytes(device: torch.device) -> int:
    """Peak memory of this process.

    On CUDA, the peak of its tensors on the device; on MPS, which counts no peak, what its driver holds now.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if device.type == "mps":
        return torch.mps.driver_allocated_memory()
    if sys.platform == "win32":
        return psutil.Process().memory_info().peak_wset
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
