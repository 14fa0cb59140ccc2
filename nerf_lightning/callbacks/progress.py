"""Progress bar: PSNR, speed, time left, and what is being rendered."""

import time
from functools import partial
from typing import Any

import lightning as L
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress

from nerf_lightning.callbacks.budget import Budget, allocate_render_seconds
from nerf_lightning.callbacks.trainer_access import find_callback, get_datamodule
from nerf_lightning.callbacks.validation import PeriodicValidation
from nerf_lightning.system import System
from nerf_lightning.utils.progress import format_duration, is_interactive

MIN_ETA_SECONDS = 10.0
"""Training seconds before the time left is shown: an early field is fog, which renders slowly."""
BAR_UPDATE_SECONDS = 0.5


def estimate_seconds_left(trainer: L.Trainer) -> float | None:
    """Seconds to the end of the run, remaining rendering at the current speed included; None while unknown."""
    budget = Budget.find(trainer)
    training, is_early = budget.seconds_left(trainer.global_step), budget.seconds < MIN_ETA_SECONDS
    if training is None or budget.render_timer.seconds_per_pixel is None or (training and is_early):
        return None
    return training + sum(allocate_render_seconds(trainer).values())


def describe_progress(trainer: L.Trainer) -> list[str]:
    """Parts of a status line, as far as known: step, held-out PSNR, time left, and what is being rendered."""
    validation = find_callback(trainer, PeriodicValidation)
    seconds, subject = estimate_seconds_left(trainer), Budget.find(trainer).render_timer.subject
    parts = [f"step {trainer.global_step}"]
    if validation is not None and validation.latest_psnr is not None:
        parts.append(f"held out {validation.latest_psnr:.2f} dB")
    left = "" if seconds is None else f"left {format_duration(seconds)}"
    return [*parts, *filter(None, [": ".join(filter(None, (left, subject)))])]


class ProgressBar(L.Callback):
    """Shows the run's progress: a bar in a terminal or notebook (with ipywidgets), elsewhere a line at intervals.

    Args:
        every_seconds: between lines, without a bar.
    """

    def __init__(self, every_seconds: float = 15):
        self.every_seconds = every_seconds
        self.console = Console()
        self.bar: RichProgress | None = None
        self._last_shown = 0.0
        self._mark_seconds, self._rays_since_mark = 0.0, 0  # training seconds at the last speed shown, and rays since

    def open(self, name: str) -> None:
        if is_interactive(self.console) and not self.console.quiet:
            status = TextColumn("{task.fields[status]}")
            columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), status
            self.bar = RichProgress(*columns, console=self.console)
            self.bar.start()
            self.bar.add_task(name, total=1.0, status="")

    def show(self, trainer: L.Trainer, system: System, force: bool = False) -> None:
        """Shows the run's progress, rendering included, if an update is due, or `force`."""
        interval = self.every_seconds if self.bar is None else BAR_UPDATE_SECONDS
        if not force and time.monotonic() - self._last_shown < interval:
            return
        self._last_shown = time.monotonic()
        seconds, budget, parts = estimate_seconds_left(trainer), Budget.find(trainer), describe_progress(trainer)
        if self._rays_since_mark:
            parts.insert(1, f"{self._rays_since_mark / max(budget.seconds - self._mark_seconds, 1e-9):,.0f} rays/s")
            self._mark_seconds, self._rays_since_mark = budget.seconds, 0
        done = budget.seconds + budget.render_timer.seconds
        fraction = system.state.progress if seconds is None else done / max(done + seconds, 1e-9)
        if self.bar is not None:
            self.bar.update(TaskID(0), completed=fraction, status="  ".join(parts))
        else:
            self.console.print(f"{fraction:4.0%}  {'  '.join(parts)}", highlight=False, soft_wrap=True)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.console.quiet = not trainer.is_global_zero  # only the first of several processes prints
        if stage == "fit":
            Budget.find(trainer).render_timer.subscribe(partial(self.show, trainer, pl_module))

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open(f"train {get_datamodule(trainer).scene.name}")
        self._mark_seconds = Budget.find(trainer).seconds

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self._rays_since_mark += pl_module.stats.rays * trainer.world_size
        self.show(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.show(trainer, pl_module, force=True)

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open("test")

    def teardown(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        self.close()
