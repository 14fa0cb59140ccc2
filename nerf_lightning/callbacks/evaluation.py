"""Evaluation: the figures of a trained field."""

import math
import sys
from collections.abc import Callable, Sequence
from statistics import fmean
from typing import Any

import lightning as L
import torch

from nerf_lightning.callbacks.attached import agreed, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.render_plan import Need
from nerf_lightning.callbacks.rendering import Renders, share_of
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.dataset.rays import view_batch
from nerf_lightning.dataset.subset import STRIP_ROWS, WHOLE, PixelSubset
from nerf_lightning.system import RENDERED_PIXELS, NeRF3D, System, aligned_psnr, misfits, psnr_of_photos
from nerf_lightning.utils.text import subsample

try:
    import resource
except ImportError:  # Windows has no such module; peak memory is then not reported
    resource = None  # type: ignore[assignment]


class Evaluation(Renders):
    """Measures all held-out views after training, then the scene's test split and how well photos fit.

    Where rendering would take longer than training (see `RenderPlan`), held-out views are measured on strips of rows that lie
    evenly in each view, and fewer views of the test split, evenly chosen.
    """

    def __init__(self) -> None:
        self.views: list[dict[str, float]] = []
        """PSNR, SSIM, seconds of rendering, and the PSNR of one plain colour, of each held-out view."""
        self.rows = 1.0
        """The share of each held-out view's rows that the test may measure; after it, that it has measured."""
        self.test: dict[str, float | None] | None = None
        """Figures of the test split, and of how many of its views; None without one, and before it is measured."""
        self.aligned: list[float] = []
        """PSNR of held-out photos with corrections of their own, where training photos had such."""
        self.photos: list[float] | None = None
        """PSNR of the training photos; None for a picture, and before they are measured."""
        self.misfits: list[dict[str, Any]] | None = None
        """Those of them that stand out."""
        self.peak_memory: int | None = None
        """Of training and measuring, bytes; charts and films take more."""
        self._pixels = 0  # measured

    @property
    def psnr(self) -> float | None:
        """Mean over the held-out views that have a figure, dB; None where none has."""
        return figures_of(self.views)["psnr"]

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        data, system = data_of(trainer), trainer.lightning_module
        left = [data.pixels_held_out(view) for view in range(len(self.views), data.held_out_views)]
        strips = sum(STRIP_ROWS * math.sqrt(pixels) for pixels in left)
        needs = {"final": Need(self.rows * sum(left), strips, scored=True)}
        if isinstance(data.scene, Scene):
            if (test := data.scene.test) is not None and self.test is None:
                needs["test"] = Need(len(test.pixels), len(test.pixels) / len(test), scored=True)
            if is_corrected(system) and not self.aligned:
                pixels = RENDERED_PIXELS * len(data.scene.val)
                needs["aligned"] = Need(pixels, pixels / 8)
        return needs

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.views, self.test, self._pixels = [], None, 0
        self.rows = agreed(trainer, share_of(trainer, pl_module, "final"))
        data_of(trainer).test_on(PixelSubset(rows=self.rows))

    def on_test_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        Budget.of(trainer).plan.start(f"held-out view {batch_idx + 1} of {data_of(trainer).held_out_views}")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        plan, pixels = Budget.of(trainer).plan, batch.height * batch.width
        plan.stop()
        plan.note(pixels, outputs["seconds"])
        self.views.append(outputs)
        self._pixels += pixels

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        data = data_of(trainer)
        data.test_on(WHOLE)
        self.rows = self._pixels / sum(map(data.pixels_held_out, range(len(self.views))))
        if trainer.logger is not None:
            figures = figures_of(self.views)
            known = {f"val/{key}": figures[key] for key in ("psnr", "ssim") if figures[key] is not None}
            trainer.logger.log_metrics({**known, TRAIN_SECONDS: Budget.of(trainer).seconds}, trainer.global_step)
        if isinstance(pl_module, NeRF3D) and isinstance(data.scene, Scene):
            if is_corrected(pl_module):
                share = share_of(trainer, pl_module, "aligned")
                with Budget.of(trainer).plan.rendering("aligned held-out photos"):
                    self.aligned = aligned_psnr(pl_module, data.scene.val, share)
            if data.scene.test is not None:
                self.test = self._measure_test(trainer, pl_module, data.scene.test)
            train, self.photos = data.scene.train, psnr_of_photos(pl_module, data.scene.train)
            self.misfits = [
                {"photo": train.name(i), "number": i, "psnr": round(self.photos[i], 2)} for i in misfits(self.photos)
            ]
        self.peak_memory = peak_memory_bytes(pl_module.device)

    def _measure_test(self, trainer: L.Trainer, system: System, views: Views) -> dict[str, float | None]:
        """Figures of as many views of the test split as there is time for."""
        share, plan, measured = share_of(trainer, system, "test"), Budget.of(trainer).plan, []
        chosen = subsample(len(views), max(1, int(share * len(views))))
        for number, view in enumerate(chosen, 1):
            with plan.rendering(f"test view {number} of {len(chosen)}"):
                (result,) = system.evaluate_views([view_batch(views, view)])
                measured.append({"psnr": result.psnr, "ssim": result.ssim})
            plan.note(result.pixels, result.seconds)
        return figures_of(measured) | {"views": len(measured), "views_in_split": len(views)}


def is_corrected(system: L.LightningModule) -> bool:
    """Whether cameras or light of the training photos were corrected."""
    return isinstance(system, NeRF3D) and system.corrections is not None and bool(system.corrections.since)


def figures_of(views: Sequence[dict[str, float]]) -> dict[str, float | None]:
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


def peak_memory_bytes(device: torch.device) -> int | None:
    """The most memory this process has held so far; None if unknown.

    On CUDA, the peak of its tensors on the device; on MPS, which keeps no such count, what its driver holds now.
    """
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if device.type == "mps":
        return torch.mps.driver_allocated_memory()
    if resource is None:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
