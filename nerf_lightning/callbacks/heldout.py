"""HeldOut: the quality curve, on views that are never trained on."""

import math
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.evaluation import statistic_of
from nerf_lightning.callbacks.rendering import Renders
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS
from nerf_lightning.dataset.subset import WHOLE, thin
from nerf_lightning.errors import InputError
from nerf_lightning.system import System
from nerf_lightning.utils.options import Count
from nerf_lightning.utils.signals import raise_if_signalled
from nerf_lightning.utils.text import subsample

MAX_SSIM_PIXELS = 1 << 21
"""Pixels of a view beyond which SSIM, which takes some ten times as long as rendering, is left to the test."""


class HeldOut(Renders):
    """Measures held-out PSNR, and SSIM up to `MAX_SSIM_PIXELS`, at fractions of the budget, with the training clock stopped.

    The last point of the curve, at the end of the budget, comes from the `Evaluation` of all views. Where rendering would take
    longer than training (see `Renders`), the others are measured on every n-th row and column, without SSIM.

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
        """[training seconds, step, PSNR], a row for each measurement that has a figure."""
        self.next_mark = 0
        """Index in `at` of the next measurement."""

    @property
    def latest(self) -> float | None:
        """The last PSNR, or None before the first."""
        return self.curve[-1][2] if self.curve else None

    def pixels_left(self, trainer: L.Trainer) -> float:
        data, training = data_of(trainer), Budget.of(trainer).progress(trainer.global_step) < 1
        points = len(self.at) - self.next_mark if training else 0
        return points * sum(map(data.pixels_held_out, subsample(data.held_out_views, self.views)))

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        passed = sum(pl_module.state.progress >= fraction for fraction in self.at)
        if passed <= self.next_mark or pl_module.state.progress >= 1.0:
            return
        figures = self.measure(trainer, pl_module)
        self.next_mark, seconds = passed, Budget.of(trainer).seconds
        if "psnr" in figures:
            self.curve.append([round(seconds, 3), trainer.global_step, figures["psnr"]])
        if trainer.logger is not None:
            named = {f"val/{key}": value for key, value in figures.items()}
            trainer.logger.log_metrics({**named, TRAIN_SECONDS: seconds}, trainer.global_step)

    def measure(self, trainer: L.Trainer, pl_module: System) -> dict[str, float]:
        """Mean figures of the views; those of which no pixel is known do not count."""
        data, budget = data_of(trainer), Budget.of(trainer)
        chosen = subsample(data.held_out_views, self.views)
        pixels = fmean(map(data.pixels_held_out, chosen))
        subset = thin(pixels, agreed(trainer, self.share(trainer, pl_module)) * pixels)
        scored = trainer.logger is not None and subset == WHOLE and pixels <= MAX_SSIM_PIXELS
        views: list[dict[str, float]] = []  # not their pictures, which would be held together
        for number, view in enumerate(chosen, 1):
            with budget.rendering(trainer, f"held-out view {number} of {len(chosen)}"):
                (result,) = pl_module.evaluate_held_out(data, [view], subset)
                budget.plan.note(result.pixels, result.seconds)
                views.append({"psnr": result.psnr, "ssim": result.ssim if scored else math.nan})
            if trainer.world_size == 1:  # several processes leave together, at the end of a step
                raise_if_signalled()
        means = {key: statistic_of(views, fmean, key) for key in ("psnr", "ssim")}
        return {key: value for key, value in means.items() if value is not None}

    def state_dict(self) -> dict[str, Any]:
        return {"curve": self.curve, "next_mark": self.next_mark}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve, self.next_mark = [list(point) for point in state_dict["curve"]], state_dict["next_mark"]
