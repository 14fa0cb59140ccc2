"""Budget: limits on steps and training seconds, the training clock, and the time for rendering."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from statistics import fmean
from typing import Any

import lightning as L

from nerf_lightning.callbacks.early_stopping import PlateauDetector
from nerf_lightning.callbacks.render_timer import MIN_RENDER_SECONDS, PROBE_PIXELS, RenderTimer, allocate_max_min_fair
from nerf_lightning.callbacks.trainer_access import broadcast_from_rank_zero, find_callback, get_datamodule
from nerf_lightning.dataset.pixel_subset import make_subset
from nerf_lightning.errors import InputError
from nerf_lightning.system import System, TrainingState
from nerf_lightning.utils.option_checks import Count, PositiveFloat
from nerf_lightning.utils.signals import defer_signals
from nerf_lightning.utils.text import subsample

MAX_PLATEAU_VIEWS, MAX_PLATEAU_PIXELS = 3, 1 << 16
"""Held-out views rendered to detect a plateau, and most pixels of each, about."""
COOLDOWN_FRACTION = 0.15
"""Length of the cool-down after a plateau, relative to the budget spent before it."""


class Budget(L.Callback):
    """Ends training at a step or time limit, or at a plateau, and sets the system's progress.

    Training time is the wall clock from the first step on, without `pause()` blocks (evaluation, images). With both limits, the
    first one reached ends the run.

    With `patience`, a few held-out views are rendered from time to time, with the clock stopped. At a plateau of their PSNR, a
    field that is still growing jumps to its full size. One at full size cools down quickly: progress, and the learning rate
    with it, runs to the end.

    Args:
        steps: optimizer steps, or None.
        seconds: seconds of training, or None.
        patience: dB that 50 % more time must still gain; None spends the whole budget.

    Raises:
        InputError: if both steps and seconds are None.
    """

    def __init__(
        self, steps: Count | None = None, seconds: PositiveFloat | None = None, patience: PositiveFloat | None = None
    ):
        if steps is None and seconds is None:
            raise InputError("budget", "", "no limit on training", hint="give budget.steps=N or budget.seconds=S")
        self.steps = steps
        self.max_seconds = seconds
        self.plateau_detector = PlateauDetector(patience) if patience is not None else None
        self.state = TrainingState()
        """The system's training state, from `setup` on."""
        self.final_plateau: dict[str, float] | None = None
        """Plateau that ends the run: its `seconds` and `step`, and `rest_db`, the predicted gain of the remaining budget."""
        self._progress_line = (0.0, 0.0, 1.0)
        """Progress as a line over the fraction spent: (start, progress there, slope)."""
        self.render_timer = RenderTimer()
        """Times rendering between training steps."""

    @staticmethod
    def find(trainer: L.Trainer) -> "Budget":
        budget = find_callback(trainer, Budget)
        if budget is None:
            raise RuntimeError("a trainer needs a Budget among its callbacks; build_trainer puts one there")
        return budget

    @property
    def seconds(self) -> float:
        """Seconds trained so far."""
        return self.state.clock.seconds

    def spent_fraction(self, step: int) -> float:
        """Fraction of the limits spent after `step` steps."""
        by_steps = step / self.steps if self.steps is not None else 0.0
        return max(by_steps, self.seconds / self.max_seconds if self.max_seconds is not None else 0.0)

    def progress(self, step: int) -> float:
        """Training progress in [0, 1] after `step` steps: the fraction spent, until a plateau."""
        spent = self.spent_fraction(step)
        start, reached, slope = self._progress_line
        return min(1.0, max(spent, reached + slope * (spent - start)))

    def render_allowance_seconds(self, step: int) -> float:
        """Seconds that rendering may take: the expected training time, at least `MIN_RENDER_SECONDS`."""
        return max(MIN_RENDER_SECONDS, self.seconds + (self.seconds_left(step) or 0.0))

    def seconds_left(self, step: int) -> float | None:
        """Expected seconds of training left after `step` steps; None before the first."""
        spent = self.spent_fraction(step)
        start, reached, slope = self._progress_line
        end = min(1.0, start + (1 - reached) / slope)
        return max(0.0, end - spent) * self.seconds / spent if spent else None

    def pause(self) -> AbstractContextManager[None]:
        """Pauses the clock for work that is not training."""
        return self.state.clock.pause()

    @contextmanager
    def pause_to_render(self, trainer: L.Trainer, subject: str) -> Iterator[None]:
        """Pauses the clock to render. A signal may interrupt the block, so it must not change checkpointed state."""
        # Several processes stop together, at the end of a step.
        interruptible = defer_signals(False) if trainer.world_size == 1 else nullcontext()
        with self.pause(), self.render_timer.measure(subject), interruptible:
            yield

    def sync_progress(self, trainer: L.Trainer) -> float:
        """Progress, equal in all processes of a run."""
        progress = self.progress(trainer.global_step)
        return progress if self.max_seconds is None else broadcast_from_rank_zero(trainer, progress)

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.state = pl_module.state

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        # A finished run that is resumed has nothing left to do.
        trainer.should_stop = self.sync_progress(trainer) >= 1.0
        self.state.clock.start(pl_module.device)

    def on_train_batch_start(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self.state.set_progress(self.sync_progress(trainer))

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self.state.set_progress(self.sync_progress(trainer))
        if self.plateau_detector is not None and self.final_plateau is None and self.state.progress < 1.0:
            self._check_plateau(trainer, pl_module, self.plateau_detector)
        if self.state.progress >= 1.0:
            trainer.should_stop = True

    def _check_plateau(self, trainer: L.Trainer, system: System, plateau: PlateauDetector) -> None:
        step = trainer.global_step
        spent = broadcast_from_rank_zero(trainer, self.spent_fraction(step))
        if not plateau.is_due(spent):
            return
        data = get_datamodule(trainer)
        views = subsample(data.num_held_out_views, MAX_PLATEAU_VIEWS)
        subset = make_subset(max(map(data.count_held_out_pixels, views)), MAX_PLATEAU_PIXELS)
        with self.pause_to_render(trainer, "views to look for a plateau"):
            psnr = fmean(view.psnr for view in system.evaluate_held_out(data, views, subset))
        if not broadcast_from_rank_zero(trainer, plateau.add_measurement(spent, psnr)):
            return
        growth = system.field.growth
        if growth is not None and self.state.progress < growth.end:
            self._progress_line = (spent, growth.end, (1 - growth.end) / (1 - spent))
            plateau.reset_trend()
            return
        gain_db = plateau.predict_gain(1 / spent) or 0.0
        self._progress_line = (spent, self.state.progress, (1 - self.state.progress) / (COOLDOWN_FRACTION * spent))
        self.final_plateau = {"seconds": round(self.seconds, 3), "step": step, "rest_db": round(gain_db, 3)}
        text = f"budget: plateau after {self.seconds:.1f} s: the rest would gain {gain_db:.2f} dB; cooling down"
        print(text, flush=True)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.state.clock.stop()

    def state_dict(self) -> dict[str, Any]:
        plateau = None if self.plateau_detector is None else self.plateau_detector.state
        plateaus = {"final_plateau": self.final_plateau, "plateau": plateau}
        return {"seconds": self.seconds, "line": self._progress_line, **plateaus}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self._progress_line, self.final_plateau = state_dict["line"], state_dict["final_plateau"]
        self.state.clock.set_seconds(state_dict["seconds"])
        if self.plateau_detector is not None and state_dict["plateau"] is not None:
            self.plateau_detector.state = state_dict["plateau"]


class RenderingCallback(L.Callback):
    """Base class of callbacks that render views within the run's time for rendering."""

    weight = 1.0
    """Weight of its share of the time."""

    def count_remaining_pixels(self, trainer: L.Trainer) -> float:
        """Pixels left to render at full size."""
        raise TypeError(f"{type(self).__name__} must define count_remaining_pixels(trainer)")

    def compute_affordable_fraction(self, trainer: L.Trainer, system: System, pixels: float | None = None) -> float:
        """Fraction of `pixels` that there is time to render; None: of all that are left."""
        render_timer, data = Budget.find(trainer).render_timer, get_datamodule(trainer)
        if render_timer.seconds_per_pixel is None:
            subset = make_subset(data.count_held_out_pixels(0), PROBE_PIXELS)
            with Budget.find(trainer).pause_to_render(trainer, "a first view"):
                (view,) = system.evaluate_held_out(data, [0], subset)
            render_timer.add_timing(view.num_pixels, view.seconds)
        pixels = self.count_remaining_pixels(trainer) if pixels is None else pixels
        cost = pixels * (render_timer.seconds_per_pixel or 0.0)
        return min(1.0, allocate_render_seconds(trainer)[self] / cost) if cost else 1.0


def allocate_render_seconds(trainer: L.Trainer) -> dict[RenderingCallback, float]:
    """Seconds that each callback may still render; 0 before the first view."""
    budget = Budget.find(trainer)
    jobs = [job for job in trainer.callbacks if isinstance(job, RenderingCallback)]  # type: ignore[attr-defined]
    costs = {job: job.count_remaining_pixels(trainer) * (budget.render_timer.seconds_per_pixel or 0.0) for job in jobs}
    allowance = budget.render_allowance_seconds(trainer.global_step) - budget.render_timer.seconds
    return allocate_max_min_fair(costs, {job: job.weight for job in jobs}, allowance)
