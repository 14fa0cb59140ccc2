"""Progress: a bar with quality, speed, the time left and what is being rendered."""

import time
from functools import partial
from typing import Any

import lightning as L
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.callbacks.rendering import render_seconds_left
from nerf_lightning.system import System
from nerf_lightning.utils.progress import animates, clock

FIRST_SECONDS = 10.0
"""Of training, before which nobody can tell how long the rest takes: an early field is full of fog."""
BAR_SECONDS = 0.5
"""Between two updates of the bar."""


class Progress(L.Callback):
    """Shows how far the run is: a bar on a terminal or in a notebook (with ipywidgets), elsewhere a line from time to time.

    The time left is the rest of the budget plus the rendering still to come (snapshots, measurements, test, orbit; see
    `RenderPlan`), at the speed of the last views.

    Args:
        every_seconds: between lines, when there is no bar.
    """

    def __init__(self, every_seconds: float = 15):
        self.every_seconds = every_seconds
        self.console = Console()
        self.bar: RichProgress | None = None
        self._shown = 0.0
        self._recent = 0.0  # seconds at the last display, and rays since
        self._rays = 0

    def left(self, trainer: L.Trainer) -> str:
        """The time left, once it can be told, and what is being rendered."""
        seconds, subject = seconds_left(trainer), Budget.of(trainer).plan.subject
        words = "" if seconds is None else f"left {clock(seconds)}"
        return ": ".join(filter(None, (words, subject)))

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.console.quiet = not trainer.is_global_zero  # only the first of several processes prints
        if stage == "fit":
            Budget.of(trainer).plan.subscribe(partial(self.show, trainer, pl_module))

    def open(self, name: str) -> None:
        if animates(self.console) and not self.console.quiet:
            status = TextColumn("{task.fields[status]}")
            columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), status
            self.bar = RichProgress(*columns, console=self.console)
            self.bar.start()
            self.bar.add_task(name, total=1.0, status="")

    def show(self, trainer: L.Trainer, system: System, status: str = "", now: bool = False) -> None:
        """Shows how far the run is, rendering included, and a few words: if it is time for that, or `now`."""
        if not now and time.monotonic() - self._shown < (self.every_seconds if self.bar is None else BAR_SECONDS):
            return
        self._shown = time.monotonic()
        seconds, budget = seconds_left(trainer), Budget.of(trainer)
        done = budget.seconds + budget.plan.spent
        fraction = system.progress if seconds is None else done / max(done + seconds, 1e-9)
        status = "  ".join(filter(None, (status or self.status(trainer), self.left(trainer))))
        if self.bar is not None:
            self.bar.update(TaskID(0), completed=fraction, status=status)
        else:
            self.console.print(f"{fraction:4.0%}  {status}", highlight=False, soft_wrap=True)

    def status(self, trainer: L.Trainer) -> str:
        """Step, held-out dB, rays a second."""
        held_out, seconds = attached(trainer, HeldOut), Budget.of(trainer).seconds
        parts = [f"step {trainer.global_step}"]
        if held_out is not None and held_out.latest is not None:
            parts.append(f"held out {held_out.latest:.2f} dB")
        if self._rays:
            parts.append(f"{self._rays / max(seconds - self._recent, 1e-9):,.0f} rays/s")
        self._recent, self._rays = seconds, 0
        return "  ".join(parts)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open(f"train {data_of(trainer).scene.name}")
        self._recent = Budget.of(trainer).seconds

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self._rays += pl_module.stats.rays * trainer.world_size
        self.show(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.show(trainer, pl_module, now=True)

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open("test")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        views = data_of(trainer).held_out_views
        status = f"view {batch_idx + 1} of {views}: {outputs['psnr']:.2f} dB"
        self.show(trainer, pl_module, status, now=batch_idx + 1 == views)

    def teardown(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        self.close()


def seconds_left(trainer: L.Trainer) -> float | None:
    """Seconds to the end of the run; None while they cannot be told."""
    budget = Budget.of(trainer)
    training, rendering = budget.seconds_left(trainer.global_step), render_seconds_left(trainer)
    if training is None or rendering is None or (training and budget.seconds < FIRST_SECONDS):
        return None
    return training + rendering
