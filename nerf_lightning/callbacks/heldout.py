"""HeldOut: the quality curve, on views that are never trained on."""

import math
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.render_plan import Need, Renders
from nerf_lightning.callbacks.rendering import share_of
from nerf_lightning.callbacks.throughput import TRAIN_SECONDS
from nerf_lightning.dataset.subset import STRIP_ROWS, WHOLE, PixelSubset, thin
from nerf_lightning.errors import InputError
from nerf_lightning.system import System
from nerf_lightning.utils.options import Count
from nerf_lightning.utils.signals import raise_if_signalled
from nerf_lightning.utils.text import subsample

LARGE = 1 << 21
"""Pixels of a view beyond which SSIM, which takes some ten times as long as rendering, is left to the test."""
MIN_PIXELS = 1 << 10
"""Of a view, that are rendered for the curve however little time there is."""


class HeldOut(Renders):
    """Measures held-out PSNR, and SSIM up to `LARGE` pixels, at fractions of the budget, with the training clock stopped.

    The last point of the curve, at the end of the budget, comes from the test over all views. Where rendering would take
    longer than training (see `RenderPlan`), the others are measured on every n-th row and column, without SSIM, and, if all
    views alone take longer, the test on strips of rows that lie evenly in each view.

    Args:
        at: fractions of the budget, ascending, in (0, 1).
        views: how many held-out views, evenly chosen; None takes all. The last point always uses all views.

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
        self.rows = 1.0
        """The share of each view's rows that the test may measure; after it, that it has measured."""
        self._tested = self._measured = 0  # views, and pixels of them

    @property
    def latest(self) -> float | None:
        """The last PSNR, or None before the first."""
        return self.curve[-1][2] if self.curve else None

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        data, training = data_of(trainer), Budget.of(trainer).progress(trainer.global_step) < 1
        points = len(self.at) - len(self.curve) if training else 0
        chosen = subsample(data.held_out_views, self.views)
        measured = points * sum(map(data.pixels_held_out, chosen))
        tested = [data.pixels_held_out(view) for view in range(self._tested, data.held_out_views)]
        strips = sum(STRIP_ROWS * math.sqrt(pixels) for pixels in tested)
        return {
            "curve": Need(measured, points * len(chosen) * MIN_PIXELS, scored=trainer.logger is not None),
            "final": Need(self.rows * sum(tested), strips, scored=True),
        }

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

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self.measure(trainer, pl_module, pl_module.state.progress)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        """What an interruption left undone is measured where it was due."""
        if trainer.global_step:
            self.measure(trainer, pl_module, Budget.of(trainer).shared_progress(trainer))

    def measure(self, trainer: L.Trainer, pl_module: System, progress: float) -> None:
        """Measures if another of the fractions has been reached."""
        due = sum(progress >= fraction for fraction in self.at)
        if due <= len(self.curve) or progress >= 1.0:
            return
        data, budget = data_of(trainer), Budget.of(trainer)
        chosen = subsample(data.held_out_views, self.views)
        pixels = fmean(map(data.pixels_held_out, chosen))
        subset = thin(pixels, max(MIN_PIXELS, agreed(trainer, share_of(trainer, pl_module, "curve")) * pixels))
        views: list[dict[str, float]] = []  # not their pictures, which would be held together
        for done, view in enumerate(chosen):
            with budget.rendering(trainer, f"held-out view {done + 1} of {len(chosen)}"):
                (result,) = pl_module.evaluate_held_out(data, [view], subset)
                budget.plan.note(result.pixels, result.seconds)
                views.append({"psnr": result.psnr})
                if trainer.logger is not None and subset == WHOLE and result.pixels <= LARGE:
                    views[-1]["ssim"] = result.ssim
            if trainer.world_size == 1:  # several processes leave together, at the end of a step
                raise_if_signalled()
        while len(self.curve) < due:  # one step may pass several marks: one measurement counts for all
            self.record(trainer, views)

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.rows, self._tested, self._measured = 1.0, 0, 0

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.rows = agreed(trainer, share_of(trainer, pl_module, "final"))
        data_of(trainer).test_on(PixelSubset(rows=self.rows))

    def on_test_batch_start(self, trainer: L.Trainer, pl_module: System, batch: Any, batch_idx: int) -> None:
        Budget.of(trainer).plan.start(f"held-out view {batch_idx + 1} of {data_of(trainer).held_out_views}")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        plan = Budget.of(trainer).plan
        plan.stop()
        plan.note(batch.height * batch.width, outputs["seconds"])
        self._tested += 1
        self._measured += batch.height * batch.width

        if self._tested == data_of(trainer).held_out_views:
            self.rows = self._measured / sum(map(data_of(trainer).pixels_held_out, range(self._tested)))

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        data_of(trainer).test_on(WHOLE)

    def state_dict(self) -> dict[str, Any]:
        return {"curve": self.curve}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.curve = [list(point) for point in state_dict["curve"]]
