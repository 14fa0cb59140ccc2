"""Progress: a bar with quality, speed and the time left."""

import time
from typing import Any

import lightning as L
from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as RichProgress

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.heldout import HeldOut
from nerf_lightning.system import System
from nerf_lightning.utils.progress import animates


def clock(seconds: float) -> str:
    """1:02:03 or 2:03."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"


class Progress(L.Callback):
    """Shows how far the run is: a bar on a terminal or in a notebook (with ipywidgets), elsewhere a line from time to time.

    The time left is the rest of the budget plus the rendering still to come (measurements, test, orbit), at the speed of the
    last view rendered.

    Args:
        every_seconds: between lines, when there is no bar.
    """

    def __init__(self, every_seconds: float = 15):
        self.every_seconds = every_seconds
        self.console = Console()
        self.bar: RichProgress | None = None
        self.task: TaskID | None = None
        self.later_views = 0
        """Views rendered after the test; the callback that renders them adds them in its `setup`."""
        self._shown = 0.0
        self._start = (0.0, 0)  # seconds and steps when this process began to train
        self._recent = 0.0  # seconds at the last display, and rays since
        self._rays = 0

    def rendering_left(self, trainer: L.Trainer) -> float:
        """Seconds of rendering still to come; 0 until a first view has been rendered."""
        held_out = attached(trainer, HeldOut)
        if held_out is None or held_out.view_seconds is None:
            return 0.0
        views = data_of(trainer).held_out_views + held_out.planned(trainer) + self.later_views
        return views * held_out.view_seconds

    def training_left(self, trainer: L.Trainer) -> float | None:
        """Seconds of training still to come; None before the first step."""
        budget, step = Budget.of(trainer), trainer.global_step
        seconds, steps = budget.seconds - self._start[0], step - self._start[1]
        left = []
        if budget.steps is not None and steps > 0:
            left.append((budget.steps - step) * seconds / steps)
        if budget.limit_seconds is not None:
            left.append(budget.limit_seconds - budget.seconds)
        return max(0.0, min(left)) if left else None

    def status(self, trainer: L.Trainer, pl_module: System) -> str:
        """One line: step, loss as dB, held-out dB, rays a second, time left."""
        budget = Budget.of(trainer)
        held_out = attached(trainer, HeldOut)
        seconds = budget.seconds
        speed = self._rays / max(seconds - self._recent, 1e-9)
        self._recent, self._rays = seconds, 0
        parts = [f"step {trainer.global_step}", f"{speed:,.0f} rays/s"]
        if held_out is not None and held_out.latest is not None:
            parts.insert(1, f"held out {held_out.latest:.2f} dB")
        training = self.training_left(trainer)
        if training is not None:
            parts.append(f"left {clock(training + self.rendering_left(trainer))}")
        return "  ".join(parts)

    def setup(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.console.quiet = not trainer.is_global_zero  # only the first of several processes prints

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

    def show(self, fraction: float, status: str) -> None:
        self._shown = time.monotonic()
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
        self._start = (self._recent, trainer.global_step)

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        self._rays += pl_module.stats.rays * trainer.world_size
        if self.due():
            self.show(pl_module.progress, self.status(trainer, pl_module))

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        self.show(pl_module.progress, self.status(trainer, pl_module))

    def on_test_start(self, trainer: L.Trainer, pl_module: System) -> None:
        self.open("test")

    def on_test_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        views = data_of(trainer).held_out_views
        if self.due() or batch_idx + 1 == views:
            self.show((batch_idx + 1) / views, f"view {batch_idx + 1} of {views}: {outputs['psnr']:.2f} dB")

    def frame(self, done: int, frames: int) -> None:
        """Called by the orbit after each of its frames."""
        if self.due() or done == frames:
            self.show(done / frames, f"frame {done} of {frames}")

    def teardown(self, trainer: L.Trainer, pl_module: System, stage: str) -> None:
        self.close()

    def on_exception(self, trainer: L.Trainer, pl_module: System, exception: BaseException) -> None:
        self.close()
