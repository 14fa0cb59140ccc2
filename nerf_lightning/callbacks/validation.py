"""Periodic validation: the curve of held-out PSNR over training."""

from statistics import fmean
from typing import Annotated, Any

import lightning as L

from nerf_lightning.callbacks.budget import Budget, RenderingCallback
from nerf_lightning.callbacks.evaluation import compute_statistic
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS_KEY
from nerf_lightning.callbacks.trainer_access import broadcast_from_rank_zero, get_datamodule
from nerf_lightning.dataset.pixel_subset import make_subset
from nerf_lightning.system import System
from nerf_lightning.utils.option_checks import Count, Gt, Lt
from nerf_lightning.utils.signals import raise_if_signalled
from nerf_lightning.utils.text import subsample


class PeriodicValidation(RenderingCallback):
    """Measures held-out PSNR at fractions of the budget, with the training clock stopped.

    `Evaluation` adds the last point of the curve, on all views. Where rendering would take longer than training (see
    `RenderingCallback`), every n-th row and column is measured.

    Args:
        fractions: of the budget.
        views: number of held-out views, evenly spaced; None takes all.
    """

    def __init__(self, fractions: list[Annotated[float, Gt(0), Lt(1)]], views: Count | None = None):
        self.fractions = fractions
        self.views = views
        self.curve: list[list[float]] = []
        """[training seconds, step, PSNR], a row for each measurement that is finite."""
        self.num_measured = 0
        """Fractions passed at the last measurement."""

    @property
    def latest_psnr(self) -> float | None:
        """Last PSNR; None before the first."""
        return self.curve[-1][2] if self.curve else None

    def count_remaining_pixels(self, trainer: L.Trainer) -> float:
        data, training = get_datamodule(trainer), Budget.find(trainer).progress(trainer.global_step) < 1
        points = len(self.fractions) - self.num_measured if training else 0
        return points * sum(map(data.count_held_out_pixels, subsample(data.num_held_out_views, self.views)))

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        passed = sum(pl_module.state.progress >= fraction for fraction in self.fractions)
        if passed <= self.num_measured or pl_module.state.progress >= 1.0:
            return
        psnr, seconds = self.measure(trainer, pl_module), Budget.find(trainer).seconds
        self.num_measured = passed
        if psnr is None:
            return
        self.curve.append([round(seconds, 3), trainer.global_step, psnr])
        if trainer.logger is not None:
            trainer.logger.log_metrics({"val/psnr": psnr, TRAIN_SECONDS_KEY: seconds}, trainer.global_step)

    def measure(self, trainer: L.Trainer, pl_module: System) -> float | None:
        """Mean PSNR of the views that have known pixels."""
        data, budget = get_datamodule(trainer), Budget.find(trainer)
        chosen = subsample(data.num_held_out_views, self.views)
        pixels = fmean(map(data.count_held_out_pixels, chosen))
        fraction = broadcast_from_rank_zero(trainer, self.compute_affordable_fraction(trainer, pl_module))
        subset = make_subset(pixels, fraction * pixels)
        views = []  # metrics alone, so that one image is in memory at a time
        for number, view in enumerate(chosen, 1):
            with budget.pause_to_render(trainer, f"held-out view {number} of {len(chosen)}"):
                (result,) = pl_module.evaluate_held_out(data, [view], subset)
            budget.render_timer.add_timing(result.num_pixels, result.seconds)
            views.append({"psnr": result.psnr})
            if trainer.world_size == 1:  # several processes stop together, at the end of a step
                raise_if_signalled()
        return compute_statistic(views, fmean, "psnr")

    def state_dict(self) -> dict[str, Any]:
        return {"curve": self.curve, "num_measured": self.num_measured}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve, self.num_measured = state_dict["curve"], state_dict["num_measured"]
