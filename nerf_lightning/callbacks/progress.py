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
        self.task: TaskID | None = None
        self._shown = 0.0
        self._recent = 0.0  # seconds at the last display, and rays since
        self._rays = 0

    def left(self, trainer: L.Trainer) -> tuple[float | None, str]:
        """Seconds to the end of the run, None while they cannot be told; words for them and for what is being rendered."""
        budget = Budget.of(trainer)
        training, rendering = budget.seconds_left(trainer.global_step), render_seconds_left(trainer)
        subject = budget.plan.subject
        if training is None or rendering is None or (training and budget.seconds < FIRST_SECONDS):
            return None, subject
        seconds = training + rendering
        words = f"left {clock(seconds)}"
        return seconds, f"{words}: {subject}" if subject else words

    def status(self, trainer: L.Trainer) -> str:
        """Step, held-out dB, rays a second."""
        held_out = attached(trainer, HeldOut)
        seconds = Budget.of(trainer).seconds
        speed = self._rays / max(seconds - self._recent, 1e-9)
        self._recent, self._rays = seconds, 0
        parts = [f"step {trainer.global_step}", f"{speed:,.0f} rays/s"]
        if held_out is not None and held_out.latest is not None:
            parts.insert(1, f"held out {held_out.latest:.2f} dB")
        return "  ".join(parts)

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.console.quiet = not trainer.is_global_zero  # only the first of several processes prints
        if stage == "fit":
            Budget.of(trainer).plan.subscribe(partial(self.on_rendering, trainer, pl_module))

    def on_rendering(self, trainer: L.Trainer, pl_module: System) -> None:
        """Called when something else is being rendered."""
        if self.due():
            self.show(trainer, pl_module, f"step {trainer.global_step}")

    def open(self, name: str) -> None:
        if self.bar is None and animates(self.console) and not self.console.quiet:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[status]}"),
            )
            self.bar = RichProgress(*columns, console=self.console)
            self.bar.start()
        if self.bar is not None:
            self.task = self.bar.add_task(name, total=1.0, status="")

    def show(self, trainer: L.Trainer, system: System, status: str) -> None:
        """Shows how far the run is, rendering included, and a few words."""
        self._shown = time.monotonic()
        seconds, left = self.left(trainer)
        budget = Budget.of(trainer)
        done = budget.seconds + budget.plan.spent
        fraction = system.state.progress if seconds is None else done / max(done + seconds, 1e-9)
        status = "  ".join(filter(None, (status, left)))
        if self.bar is not None and self.task is not None:
            self.bar.update(self.task, completed=fraction, status=status)
        else:
            self.console.print(f"{fraction:4.0%}  {status}", highlight=False, soft_wrap=True)

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()
            self.bar = None

    def due(self) -> bool:
        return time.monotonic() - self._shown >= (0.5 if self.bar is not None else self.every_seconds)

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open(f"train {data_of(trainer).scene.name}")
        self._recent = Budget.of(trainer).seconds

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        self._rays += pl_module.stats.rays * trainer.world_size
        if self.due():
            self.show(trainer, pl_module, self.status(trainer))

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.show(trainer, pl_module, self.status(trainer))

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open("test")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        views = data_of(trainer).held_out_views
        if self.due() or batch_idx + 1 == views:
            self.show(trainer, pl_module, f"view {batch_idx + 1} of {views}: {outputs['psnr']:.2f} dB")

    def teardown(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        self.close()
