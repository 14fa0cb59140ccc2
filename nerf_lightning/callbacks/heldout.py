"""HeldOut: the quality curve, on views that are never trained on."""

import math
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.errors import InputError
from nerf_lightning.system import System
from nerf_lightning.utils.ending import leave_if_asked
from nerf_lightning.utils.evenly import evenly
from nerf_lightning.utils.untrusted import count, number

LARGE = 1 << 21
"""Pixels of a view beyond which SSIM, which takes some ten times as long as rendering, is left to the test."""


class HeldOut(L.Callback):
    """Measures held-out PSNR, and SSIM up to `LARGE` pixels, at fractions of the budget, with the training clock stopped.

    The last point of the curve, at the end of the budget, comes from the test over all views.

    Args:
        at: fractions of the budget, ascending, in (0, 1).
        views: how many held-out views, evenly chosen. None takes all, or fewer if measuring them would take longer than
            training and longer than half a minute. The last point always uses all views.

    Raises:
        InputError: for fractions outside (0, 1) or less than one view.
    """

    def __init__(self, at: list[float], views: int | None = None):
        if any(not 0 < fraction < 1 for fraction in at) or sorted(at) != list(at):
            raise InputError("callbacks.heldout.at", "", str(list(at)), "ascending fractions between 0 and 1")
        if views is not None and views < 1:
            raise InputError("callbacks.heldout.views", "", str(views), "at least 1, or null for all")
        self.at = list(at)
        self.views = views
        self.curve: list[list[float]] = []
        """[training seconds, step, PSNR], a row for each measurement; nan where there was no figure."""
        self.view_seconds: float | None = None
        """Rendering time of a view at the last measurement."""

    @property
    def latest(self) -> float | None:
        """The last PSNR, or None before the first."""
        return self.curve[-1][2] if self.curve else None

    def planned(self, trainer: L.Trainer) -> int:
        """Views still to be rendered in measurements during training."""
        total = data_of(trainer).held_out_views
        return (len(self.at) - len(self.curve)) * len(evenly(total, self.count(trainer)))

    def count(self, trainer: L.Trainer) -> int | None:
        """How many views a measurement takes; None for all."""
        if self.views is not None or not self.view_seconds:
            return self.views
        allowed = Budget.of(trainer).drawing_seconds(trainer.global_step) / len(self.at)
        return max(1, int(allowed / self.view_seconds))

    def record(self, trainer: L.Trainer, views: list[dict[str, float]]) -> None:
        """Adds a point to the curve and to the log; views of which no pixel is known do not count."""
        counted = [view["psnr"] for view in views if math.isfinite(view["psnr"])]
        quality = fmean(counted) if counted else math.nan
        self.view_seconds = fmean(view["seconds"] for view in views)
        self.curve.append([round(Budget.of(trainer).seconds, 3), trainer.global_step, round(quality, 4)])
        if trainer.logger is not None:
            figures = {"heldout/psnr": quality}
            if all("ssim" in view for view in views):
                figures["heldout/ssim"] = fmean(view["ssim"] for view in views)
            trainer.logger.log_metrics(figures, trainer.global_step)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self.measure(trainer, pl_module, pl_module.progress)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        """What an interruption left undone is measured where it was due."""
        if trainer.global_step:
            self.measure(trainer, pl_module, Budget.of(trainer).shared_progress(trainer))

    def measure(self, trainer: L.Trainer, pl_module: System, progress: float) -> None:
        """Measures if another of the fractions has been reached."""
        due = sum(progress >= fraction for fraction in self.at)
        if due <= len(self.curve) or progress >= 1.0:
            return
        with Budget.of(trainer).paused():
            data = data_of(trainer)
            if self.views is None and self.view_seconds is None:  # not yet known: how many views there is time for
                self.view_seconds = next(pl_module.evaluate_held_out(data, [0])).seconds
            chosen = evenly(data.held_out_views, self.count(trainer))
            if self.views is None and len(chosen) < data.held_out_views and not self.curve:
                print(
                    f"{len(chosen)} of {data.held_out_views} held-out views are measured while training, as one takes "
                    f"{self.view_seconds:.1f} s; callbacks.heldout.views={data.held_out_views} takes all"
                )
            views: list[dict[str, float]] = []  # not their pictures, which would be held together
            for result in pl_module.evaluate_held_out(data, chosen):
                views.append({"psnr": result.psnr, "seconds": result.seconds})
                if trainer.logger is not None and result.truth.shape[:2].numel() <= LARGE:
                    views[-1]["ssim"] = result.ssim
                if trainer.world_size == 1:  # several processes leave together, at the end of a step
                    leave_if_asked()
            while len(self.curve) < due:  # one step may pass several marks: one measurement counts for all
                self.record(trainer, views)

    def state_dict(self) -> dict[str, Any]:
        return {"curve": self.curve, "view_seconds": self.view_seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve = [[number(spent), count(step), float(quality)] for spent, step, quality in state_dict["curve"]]
        seconds = state_dict["view_seconds"]
        self.view_seconds = None if seconds is None else number(seconds)
