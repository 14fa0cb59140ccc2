"""Budget: how long to train, by the steps or by the clock, and the clock itself; and what it leaves for rendering."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import agreed, attached, data_of
from nerf_lightning.callbacks.plateau import Plateau
from nerf_lightning.callbacks.render_plan import MIN_SECONDS, PROBE_PIXELS, RenderPlan, allot
from nerf_lightning.dataset.subset import thin
from nerf_lightning.errors import InputError
from nerf_lightning.system import System, TrainingState
from nerf_lightning.utils.options import Count, Positive
from nerf_lightning.utils.signals import defer_signals
from nerf_lightning.utils.text import subsample

LOOK_AT, LOOK_PIXELS = 3, 1 << 16
"""Held-out views rendered to look for a plateau, and about the most pixels of each."""
COOLING = 0.15
"""Cooling down after a plateau takes this share of what was spent up to it."""


class Budget(L.Callback):
    """Stops training when the budget is spent, or no longer worth spending, and tells the system its progress.

    Training time is the wall clock from the first step on, less what runs inside `paused()` (evaluation, pictures). With
    both limits, the first one reached ends the run.

    With `patience`, a few held-out views are rendered from time to time, with the clock stopped. When their quality reaches a
    plateau, a field that is still growing jumps to its full size. One at full size cools down quickly: progress, and the
    learning rate with it, runs to the end.

    Args:
        steps: optimiser steps, or None.
        seconds: seconds of training, or None.
        patience: dB that 50 % more time must still gain; None spends the whole budget.

    Raises:
        InputError: where steps and seconds are None.
    """

    def __init__(
        self,
        steps: Count | None = None,
        seconds: Positive | None = None,
        patience: Positive | None = None,
    ):
        if steps is None and seconds is None:
            raise InputError("budget", "", "neither steps nor seconds", "budget.steps=N or budget.seconds=S")
        self.steps = steps
        self.limit_seconds = seconds
        self.plateau = Plateau(patience) if patience is not None else None
        self.state = TrainingState()
        """The system's, from `setup` on."""
        self.stopped: dict[str, float] | None = None
        """The plateau that ends the run: its `seconds` and `step`, and `rest_db`, what the rest of the budget would add."""
        self._line = (0.0, 0.0, 1.0)
        """Progress is a line over the share spent: (start, progress there, slope)."""
        self.plan = RenderPlan()
        """Of what is rendered beside training."""

    @staticmethod
    def of(trainer: L.Trainer) -> "Budget":
        """The trainer's budget."""
        budget = attached(trainer, Budget)
        if budget is None:
            raise RuntimeError("a trainer needs a Budget among its callbacks; build_trainer puts one there")
        return budget

    @property
    def seconds(self) -> float:
        """Seconds trained so far."""
        return self.state.clock.seconds

    def spent(self, step: int) -> float:
        """Fraction of the limits spent after `step` steps."""
        by_steps = step / self.steps if self.steps is not None else 0.0
        return max(by_steps, self.seconds / self.limit_seconds if self.limit_seconds is not None else 0.0)

    def progress(self, step: int) -> float:
        """Share of the training done after `step` steps, in [0, 1]: that of the limits spent, until there is a plateau."""
        spent = self.spent(step)
        start, reached, slope = self._line
        return min(1.0, max(spent, reached + slope * (spent - start)))

    def render_seconds(self, step: int) -> float:
        """Seconds that rendering beside training may take: as long as training is expected to take, judged after `step` steps,
        and at least `MIN_SECONDS`."""
        return max(MIN_SECONDS, self.seconds + (self.seconds_left(step) or 0.0))

    def seconds_left(self, step: int) -> float | None:
        """Seconds of training still to come, judged after `step` steps; None before the first."""
        spent = self.spent(step)
        start, reached, slope = self._line
        end = min(1.0, start + (1 - reached) / slope)
        return max(0.0, end - spent) * self.seconds / spent if spent else None

    def paused(self) -> AbstractContextManager[None]:
        """Stops the clock for work that is not training."""
        return self.state.clock.paused()

    @contextmanager
    def rendering(self, trainer: L.Trainer, subject: str) -> Iterator[None]:
        """Stops the clock for a block that renders, which a signal ends: it must change nothing that a checkpoint keeps."""
        alone = trainer.world_size == 1  # several processes leave together, at the end of a step
        with self.paused(), self.plan.rendering(subject), defer_signals(False) if alone else nullcontext():
            yield

    def shared_progress(self, trainer: L.Trainer) -> float:
        """`progress`, the same in all processes of a run."""
        progress = self.progress(trainer.global_step)
        return progress if self.limit_seconds is None else agreed(trainer, progress)

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.state = pl_module.state

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        # A finished run that is resumed has nothing left to do.
        trainer.should_stop = self.shared_progress(trainer) >= 1.0
        self.state.clock.start(pl_module.device)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self.state.advance(self.shared_progress(trainer))

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self.state.advance(self.shared_progress(trainer))
        if self.plateau is not None and self.stopped is None and self.state.progress < 1.0:
            self._look_for_plateau(trainer, pl_module, self.plateau)
        if self.state.progress >= 1.0:
            trainer.should_stop = True

    def _look_for_plateau(self, trainer: L.Trainer, system: System, plateau: Plateau) -> None:
        step = trainer.global_step
        spent = agreed(trainer, self.spent(step))
        if not plateau.due(spent):
            return
        data = data_of(trainer)
        chosen = subsample(data.held_out_views, LOOK_AT)
        some = thin(max(map(data.pixels_held_out, chosen)), LOOK_PIXELS)
        with self.rendering(trainer, "views to look for a plateau"):
            quality = fmean(view.psnr for view in system.evaluate_held_out(data, chosen, some))
        if not agreed(trainer, plateau.note(spent, quality)):
            return
        growth = system.field.growth
        if growth is not None and self.state.progress < growth.end:
            self._line = (spent, growth.end, (1 - growth.end) / (1 - spent))
            plateau.start()
            return
        rest = plateau.gain(1 / spent) or 0.0
        self._line = (spent, self.state.progress, (1 - self.state.progress) / (COOLING * spent))
        self.stopped = {"seconds": round(self.seconds, 3), "step": step, "rest_db": round(rest, 3)}
        print(
            f"budget: plateau after {self.seconds:.1f} s: the rest would bring {rest:.2f} dB; cooling down", flush=True
        )

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.state.clock.stop()

    def state_dict(self) -> dict[str, Any]:
        plateau = None if self.plateau is None else self.plateau.state
        return {"seconds": self.seconds, "line": self._line, "stopped": self.stopped, "plateau": plateau}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._line, self.stopped = state_dict["line"], state_dict["stopped"]
        self.state.clock.set_seconds(state_dict["seconds"])
        if self.plateau is not None and state_dict["plateau"] is not None:
            self.plateau.state = state_dict["plateau"]


class Renders(L.Callback):
    """A callback that renders views, in the time that the run has for them."""

    weight = 1.0
    """Of its time, where there is not enough for all."""

    def pixels_left(self, trainer: L.Trainer) -> float:
        """Pixels that are still to be rendered, where there is time for all."""
        raise TypeError(f"{type(self).__name__} must define pixels_left(trainer)")

    def share(self, trainer: L.Trainer, system: System, pixels: float | None = None) -> float:
        """The share of so many pixels for which there is time; None takes all that are left."""
        plan, data = Budget.of(trainer).plan, data_of(trainer)
        if plan.pixel_seconds is None:
            some = thin(data.pixels_held_out(0), PROBE_PIXELS)
            with Budget.of(trainer).rendering(trainer, "a first look"):
                (view,) = system.evaluate_held_out(data, [0], some)
            plan.note(view.pixels, view.seconds)
        cost = (self.pixels_left(trainer) if pixels is None else pixels) * (plan.pixel_seconds or 0.0)
        return min(1.0, render_seconds(trainer)[self] / cost) if cost else 1.0


def render_seconds(trainer: L.Trainer) -> dict[Renders, float]:
    """Seconds that each callback may still render; 0 before the first view."""
    budget = Budget.of(trainer)
    jobs = [one for one in trainer.callbacks if isinstance(one, Renders)]  # type: ignore[attr-defined]
    costs = {one: one.pixels_left(trainer) * (budget.plan.pixel_seconds or 0.0) for one in jobs}
    allowance = budget.render_seconds(trainer.global_step) - budget.plan.spent
    return allot(costs, {one: one.weight for one in jobs}, allowance)
