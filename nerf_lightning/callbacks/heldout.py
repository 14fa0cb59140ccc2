"""HeldOut: the quality curve, on views that are never trained on."""

from statistics import fmean
from typing import Annotated, Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, data_of
from nerf_lightning.callbacks.budget import Budget, Renders
from nerf_lightning.callbacks.evaluation import statistic_of
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS
from nerf_lightning.dataset.subset import thin
from nerf_lightning.system import System
from nerf_lightning.utils.options import Above, Below, Count
from nerf_lightning.utils.signals import raise_if_signalled
from nerf_lightning.utils.text import subsample


class HeldOut(Renders):
    """Measures held-out PSNR at fractions of the budget, with the training clock stopped.

    The last point of the curve, at the end of the budget, comes from the `Evaluation` of all views. Where rendering would take
    longer than training (see `Renders`), the others are measured on every n-th row and column.

    Args:
        at: fractions of the budget.
        views: how many held-out views, evenly chosen; None takes all.
    """

    def __init__(self, at: list[Annotated[float, Above(0), Below(1)]], views: Count | None = None):
        self.at = at
        self.views = views
        self.curve: list[list[float]] = []
        """[training seconds, step, PSNR], a row for each measurement that has a figure."""
        self.next_mark = 0
        """How many of them were passed when it was measured last."""

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
        quality, seconds = self.measure(trainer, pl_module), Budget.of(trainer).seconds
        self.next_mark = passed
        if quality is None:
            return
        self.curve.append([round(seconds, 3), trainer.global_step, quality])
        if trainer.logger is not None:
            trainer.logger.log_metrics({"val/psnr": quality, TRAIN_SECONDS: seconds}, trainer.global_step)

    def measure(self, trainer: L.Trainer, pl_module: System) -> float | None:
        """Mean PSNR of the views; those of which no pixel is known do not count."""
        data, budget = data_of(trainer), Budget.of(trainer)
        chosen = subsample(data.held_out_views, self.views)
        pixels = fmean(map(data.pixels_held_out, chosen))
        subset = thin(pixels, agreed(trainer, self.share(trainer, pl_module)) * pixels)
        views = []  # not their pictures, which would be held together
        for number, view in enumerate(chosen, 1):
            with budget.rendering(trainer, f"held-out view {number} of {len(chosen)}"):
                (result,) = pl_module.evaluate_held_out(data, [view], subset)
            budget.plan.note(result.pixels, result.seconds)
            views.append({"psnr": result.psnr})
            if trainer.world_size == 1:  # several processes leave together, at the end of a step
                raise_if_signalled()
        return statistic_of(views, fmean, "psnr")

    def state_dict(self) -> dict[str, Any]:
        return {"curve": self.curve, "next_mark": self.next_mark}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve, self.next_mark = state_dict["curve"], state_dict["next_mark"]
