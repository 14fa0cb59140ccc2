"""Evaluation: the figures of a trained field."""

import math
import sys
from collections.abc import Callable, Sequence
from statistics import fmean, median
from typing import Any

import lightning as L
import psutil
import torch

from nerf_lightning.callbacks.attached import agreed, data_of
from nerf_lightning.callbacks.budget import Budget, Renders
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS
from nerf_lightning.dataset import Views
from nerf_lightning.dataset.rays import view_batch
from nerf_lightning.dataset.subset import WHOLE, PixelSubset
from nerf_lightning.system import RENDERED_PIXELS, System, aligned_psnr, misfits, psnr_of_photos
from nerf_lightning.utils.text import subsample

FIGURES = (
    *("psnr", "ssim", "psnr_worst_view", "psnr_aligned", "rows_measured", "test", "render_seconds_per_view"),
    *("peak_memory_bytes", "misfits"),
)
"""Keys of results.json."""


class Evaluation(Renders):
    """Measures all held-out views after training, then the scene's test split and how well photos fit.

    Where rendering would take longer than training (see `Renders`), held-out views are measured on strips of rows that lie
    evenly in each view, and fewer views of the test split, evenly chosen.
    """

    weight = 30.0

    def __init__(self) -> None:
        self.figures: dict[str, Any] = dict.fromkeys(FIGURES)
        """For results.json; None for what is not measured, or not yet."""
        self.views: list[dict[str, float]] = []
        """PSNR, SSIM, seconds of rendering, and the PSNR of one plain colour, of each held-out view."""
        self.photos: list[float] = []
        """PSNR of the training photos; none of a picture."""
        self._rows = 1.0  # share of each held-out view's that is measured

    def pixels_left(self, trainer: L.Trainer) -> float:
        data, test = data_of(trainer), data_of(trainer).scene.test
        pixels = self._rows * sum(map(data.pixels_held_out, range(len(self.views), data.held_out_views)))
        if trainer.lightning_module.is_corrected and self.figures["psnr_aligned"] is None:
            pixels += RENDERED_PIXELS * data.held_out_views
        return pixels + (len(test.pixels) if test is not None and self.figures["test"] is None else 0)

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        data = data_of(trainer)
        pixels = sum(map(data.pixels_held_out, range(data.held_out_views)))
        self._rows = agreed(trainer, self.share(trainer, pl_module, pixels))
        data.test_on(PixelSubset(rows=self._rows))

    def on_test_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        Budget.of(trainer).plan.start(f"held-out view {batch_idx + 1} of {data_of(trainer).held_out_views}")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        plan = Budget.of(trainer).plan
        plan.stop()
        plan.note(batch.height * batch.width, outputs["seconds"])
        self.views.append(outputs)

    def on_test_end(self, trainer: L.Trainer, pl_module: Any) -> None:
        data, figures = data_of(trainer), self.figures
        data.test_on(WHOLE)
        figures |= figures_of(self.views)
        figures["rows_measured"] = round(self._rows, 4)
        figures["render_seconds_per_view"] = statistic_of(self.views, median, "seconds")
        if trainer.logger is not None:
            known = {f"val/{key}": figures[key] for key in ("psnr", "ssim") if figures[key] is not None}
            trainer.logger.log_metrics({**known, TRAIN_SECONDS: Budget.of(trainer).seconds}, trainer.global_step)
        if pl_module.is_corrected:
            share = self.share(trainer, pl_module)
            with Budget.of(trainer).plan.rendering("aligned held-out photos"):
                figures["psnr_aligned"] = round(fmean(aligned_psnr(pl_module, data.scene.val, share)), 4)
        if data.scene.test is not None:
            figures["test"] = self._measure_test(trainer, pl_module, data.scene.test)
        if data.has_cameras:
            train = data.scene.train
            self.photos = psnr_of_photos(pl_module, train)
            figures["misfits"] = [
                {"photo": train.name(i), "number": i, "psnr": round(self.photos[i], 2)} for i in misfits(self.photos)
            ]
        figures["peak_memory_bytes"] = peak_memory_bytes(pl_module.device)  # charts and films take more

    def _measure_test(self, trainer: L.Trainer, system: System, views: Views) -> dict[str, Any]:
        """Figures of as many views of the test split as there is time for."""
        share, plan, measured = self.share(trainer, system), Budget.of(trainer).plan, []
        chosen = subsample(len(views), max(1, int(share * len(views))))
        for number, view in enumerate(chosen, 1):
            with plan.rendering(f"test view {number} of {len(chosen)}"):
                (result,) = system.evaluate_views([view_batch(views, view)])
                measured.append({"psnr": result.psnr, "ssim": result.ssim})
            plan.note(result.pixels, result.seconds)
        return {**figures_of(measured), "views": len(measured), "views_in_split": len(views)}


def figures_of(views: Sequence[dict[str, float]]) -> dict[str, Any]:
    """Means over views, and the worst of them."""
    return {
        "psnr": statistic_of(views, fmean, "psnr"),
        "ssim": statistic_of(views, fmean, "ssim"),
        "psnr_worst_view": statistic_of(views, min, "psnr"),
    }


def statistic_of(views: Sequence[dict[str, float]], statistic: Callable[..., float], key: str) -> float | None:
    """A statistic over the views that have a finite figure; None where no view has."""
    values = [view[key] for view in views if math.isfinite(view[key])]
    return round(statistic(values), 4) if values else None


def peak_memory_bytes(device: torch.device) -> int:
    """The most memory this process has held so far.

    On CUDA, the peak of its tensors on the device; on MPS, which keeps no such count, what its driver holds now.
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
