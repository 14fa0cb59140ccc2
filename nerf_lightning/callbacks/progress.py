"""Progress: a bar with quality, speed, the time left and what is being rendered."""

import time
from functools import partial
from typing import Any

import lightning as L
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.budget import Budget, render_seconds
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.system import System
from nerf_lightning.utils.progress import animates, clock

FIRST_SECONDS = 10.0
"""Of training, before which nobody can tell how long the rest takes: an early field is full of fog."""
BAR_SECONDS = 0.5
"""Between two updates of the bar."""


def seconds_left(trainer: L.Trainer) -> float | None:
    """Seconds to the end of the run: the rest of the budget, and the rendering still to come at the speed of the last views.

    None while they cannot be told.
    """
    budget = Budget.of(trainer)
    training = budget.seconds_left(trainer.global_step)
    if training is None or budget.plan.pixel_seconds is None or (training and budget.seconds < FIRST_SECONDS):
        return None
    return training + sum(render_seconds(trainer).values())


def describe_progress(trainer: L.Trainer) -> list[str]:
    """The step, the held-out dB, the time left, and what is being rendered, as far as they are known."""
    held_out, seconds, subject = attached(trainer, HeldOut), seconds_left(trainer), Budget.of(trainer).plan.subject
    parts = [f"step {trainer.global_step}"]
    if held_out is not None and held_out.latest is not None:
        parts.append(f"held out {held_out.latest:.2f} dB")
    left = "" if seconds is None else f"left {clock(seconds)}"
    return [*parts, *filter(None, [": ".join(filter(None, (left, subject)))])]


class Progress(L.Callback):
    """Shows how far the run is: a bar on a terminal or in a notebook (with ipywidgets), elsewhere a line from time to time.

    Args:
        every_seconds: between lines, when there is no bar.
    """

    def __init__(self, every_seconds: float = 15):
        self.every_seconds = every_seconds
        self.console = Console()
        self.bar: RichProgress | None = None
        self._shown = 0.0
        self._mark, self._rays = 0.0, 0  # seconds of training when a speed was shown, and rays since

    def open(self, name: str) -> None:
        if animates(self.console) and not self.console.quiet:
            status = TextColumn("{task.fields[status]}")
            columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), status
            self.bar = RichProgress(*columns, console=self.console)
            self.bar.start()
            self.bar.add_task(name, total=1.0, status="")

    def show(self, trainer: L.Trainer, system: System, now: bool = False) -> None:
        """Shows how far the run is, rendering included, if it is time for that, or `now`."""
        if not now and time.monotonic() - self._shown < (self.every_seconds if self.bar is None else BAR_SECONDS):
            return
        self._shown = time.monotonic()
        seconds, budget, parts = seconds_left(trainer), Budget.of(trainer), describe_progress(trainer)
        if self._rays:
            parts.insert(1, f"{self._rays / max(budget.seconds - self._mark, 1e-9):,.0f} rays/s")
            self._mark, self._rays = budget.seconds, 0
        done = budget.seconds + budget.plan.spent
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
            Budget.of(trainer).plan.subscribe(partial(self.show, trainer, pl_module))

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open(f"train {data_of(trainer).scene.name}")
        self._mark = Budget.of(trainer).seconds

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self._rays += pl_module.stats.rays * trainer.world_size
        self.show(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.show(trainer, pl_module, now=True)

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open("test")

    def teardown(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        self.close()
