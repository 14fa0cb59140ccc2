"""HeldOut: the quality curve, on views that are never trained on."""

import math
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, attached, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.render_plan import Need
from nerf_lightning.callbacks.rendering import Renders, share_of
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS
from nerf_lightning.dataset.subset import WHOLE, thin
from nerf_lightning.errors import InputError
from nerf_lightning.system import System
from nerf_lightning.utils.options import Count
from nerf_lightning.utils.signals import raise_if_signalled
from nerf_lightning.utils.text import subsample

MAX_SSIM_PIXELS = 1 << 21
"""Pixels of a view beyond which SSIM, which takes some ten times as long as rendering, is left to the test."""
MIN_PIXELS = 1 << 10
"""Of a view, that are rendered for the curve however little time there is."""


class HeldOut(Renders):
    """Measures held-out PSNR, and SSIM up to `MAX_SSIM_PIXELS`, at fractions of the budget, with the training clock stopped.

    The last point of the curve, at the end of the budget, comes from the `Evaluation` of all views. Where rendering would take
    longer than training (see `RenderPlan`), the others are measured on every n-th row and column, without SSIM.

    Args:
        at: fractions of the budget, ascending, in (0, 1).
        views: how many held-out views, evenly chosen; None takes all.

    Raises:
        InputError: for fractions outside (0, 1), or not in order.
    """

    def __init__(self, at: list[float], views: Count | None = None):
        if any(not 0 < fraction < 1 for fraction in at) or sorted(at) != list(at):
            raise InputError("callbacks.heldout.at", "", str(list(at)), "ascending fractions between 0 and 1")
        self.at = list(at)
        self.views = views
        self.curve: list[list[float]] = []
        """[training seconds, step, PSNR], a row for each measurement; nan where there was no figure."""
        self.next_mark = 0
        """Index in `at` of the next measurement."""

    @property
    def latest(self) -> float | None:
        """The last PSNR, or None before the first."""
        return self.curve[-1][2] if self.curve else None

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        data, training = data_of(trainer), Budget.of(trainer).progress(trainer.global_step) < 1
        points = len(self.at) - self.next_mark if training else 0
        chosen = subsample(data.held_out_views, self.views)
        pixels, least = points * sum(map(data.pixels_held_out, chosen)), points * len(chosen) * MIN_PIXELS
        return {"curve": Need(pixels, least, scored=trainer.logger is not None)}

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        passed = sum(pl_module.progress >= fraction for fraction in self.at)
        if passed > self.next_mark and pl_module.progress < 1.0:
            views = self.measure(trainer, pl_module)
            self.next_mark = passed
            self.record(trainer, views)

    def measure(self, trainer: L.Trainer, pl_module: System) -> list[dict[str, float]]:
        """Figures of each view: not their pictures, which would be held together."""
        data, budget = data_of(trainer), Budget.of(trainer)
        chosen = subsample(data.held_out_views, self.views)
        pixels = fmean(map(data.pixels_held_out, chosen))
        subset = thin(pixels, max(MIN_PIXELS, agreed(trainer, share_of(trainer, pl_module, "curve")) * pixels))
        views: list[dict[str, float]] = []
        for number, view in enumerate(chosen, 1):
            with budget.rendering(trainer, f"held-out view {number} of {len(chosen)}"):
                (result,) = pl_module.evaluate_held_out(data, [view], subset)
                budget.plan.note(result.pixels, result.seconds)
                views.append({"psnr": result.psnr})
                if trainer.logger is not None and subset == WHOLE and result.pixels <= MAX_SSIM_PIXELS:
                    views[-1]["ssim"] = result.ssim
            if trainer.world_size == 1:  # several processes leave together, at the end of a step
                raise_if_signalled()
        return views

    def record(self, trainer: L.Trainer, views: list[dict[str, float]]) -> None:
        """Adds a point to the curve and to the log; views of which no pixel is known do not count."""
        counted = [view["psnr"] for view in views if math.isfinite(view["psnr"])]
        quality = fmean(counted) if counted else math.nan
        self.curve.append([round(Budget.of(trainer).seconds, 3), trainer.global_step, round(quality, 4)])
        if trainer.logger is not None:
            figures = {"val/psnr": quality, TRAIN_SECONDS: Budget.of(trainer).seconds}
            if all("ssim" in view for view in views):
                figures["val/ssim"] = fmean(view["ssim"] for view in views)
            trainer.logger.log_metrics(figures, trainer.global_step)

    def state_dict(self) -> dict[str, Any]:
        return {"curve": self.curve, "next_mark": self.next_mark}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve, self.next_mark = [list(point) for point in state_dict["curve"]], state_dict["next_mark"]


def measured_curve(trainer: L.Trainer) -> list[list[float]]:
    """The rows of the quality curve that have a figure."""
    held_out = attached(trainer, HeldOut)
    return [point for point in held_out.curve if math.isfinite(point[2])] if held_out is not None else []
