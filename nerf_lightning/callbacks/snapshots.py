"""Snapshots: renders of a held-out view during training."""

from itertools import count, takewhile
from pathlib import Path
from typing import Any

import lightning as L

from nerf_lightning.callbacks.budget import Budget, RenderingCallback
from nerf_lightning.callbacks.trainer_access import get_datamodule
from nerf_lightning.dataset import DataModule
from nerf_lightning.dataset.pixel_subset import make_subset
from nerf_lightning.drawing.panels import limit_width, make_result_panel, to_uint8, write_png
from nerf_lightning.errors import InputError
from nerf_lightning.system import System
from nerf_lightning.utils.option_checks import Count

MAX_LOG_WIDTH = 640
"""Most pixels across of an image for TensorBoard, which takes 0.1 s per megabyte."""
SNAPSHOT_FOLDER, FINAL_FILE, TRUTH_FILE = "snapshots", "final.png", "truth.png"
"""Inside the run folder: all snapshots, the latest render, and its ground truth."""


class Snapshots(RenderingCallback):
    """Writes truth, render and depth of one held-out view as PNG and to TensorBoard, also at the end.

    Of views beyond `max_pixels`, and where time is short (see `RenderingCallback`), every n-th row and column is rendered.

    Args:
        steps: after which steps; None means 10, 20, 50, 100, 200, 500, ...
        view: index of the held-out view.
        max_pixels: of a snapshot; None takes all.

    Raises:
        InputError: from `check`, if there is no such view.
    """

    def __init__(self, steps: list[int] | None = None, view: int = 0, max_pixels: Count | None = 640_000):
        self.steps = steps
        self.view = view
        self.max_pixels = max_pixels
        self._last_written_step: int | None = None

    def list_snapshot_steps(self, last: float) -> list[int]:
        """Steps after which there is a snapshot, up to `last`."""
        if self.steps is not None:
            return [step for step in self.steps if step <= last]
        spaced = (digit * 10**power for power in count(1) for digit in (1, 2, 5))
        return list(takewhile(lambda step: step <= last, spaced))

    def check(self, data: DataModule) -> None:
        """Checks the view's index, before a run writes anything."""
        views = data.num_held_out_views
        if not 0 <= self.view < views:
            raise InputError("callbacks.snapshots.view", "", str(self.view), f"a held-out view from 0 to {views - 1}")

    def count_remaining_pixels(self, trainer: L.Trainer) -> float:
        step, progress = trainer.global_step, Budget.find(trainer).progress(trainer.global_step)
        last = step / progress if progress else step
        steps = {*self.list_snapshot_steps(last), round(last)} - {self._last_written_step}
        return sum(due >= step for due in steps) * self.count_pixels(trainer)

    def count_pixels(self, trainer: L.Trainer) -> int:
        """Pixels of a snapshot at full size."""
        pixels = get_datamodule(trainer).count_held_out_pixels(self.view)
        return min(pixels, self.max_pixels or pixels)

    def write(self, trainer: L.Trainer, pl_module: System) -> None:
        if not trainer.is_global_zero:
            return
        budget, data, step = Budget.find(trainer), get_datamodule(trainer), trainer.global_step
        folder, logger = Path(trainer.default_root_dir), trainer.logger
        max_pixels = self.compute_affordable_fraction(trainer, pl_module) * self.count_pixels(trainer)
        with budget.pause_to_render(trainer, "snapshot"):
            subset = make_subset(data.count_held_out_pixels(self.view), max_pixels)
            (result,) = pl_module.evaluate_held_out(data, [self.view], subset)
        budget.render_timer.add_timing(result.num_pixels, result.seconds)
        self._last_written_step = step
        with budget.pause():  # not `pause_to_render`: a signal must not interrupt writing
            caption = f"{data.scene.name}, step {step}, {budget.seconds:.0f} s, {result.psnr:.2f} dB"
            picture = make_result_panel(result, caption)
            write_png(folder / SNAPSHOT_FOLDER / f"step_{step:07d}.png", picture)
            write_png(folder / FINAL_FILE, to_uint8(result.rgb))
            if not (folder / TRUTH_FILE).exists():
                write_png(folder / TRUTH_FILE, to_uint8(result.truth))
            if isinstance(logger, L.pytorch.loggers.TensorBoardLogger):
                logger.experiment.add_image("images/view", limit_width(picture, MAX_LOG_WIDTH), step, dataformats="HWC")
                logger.experiment.flush()  # while paused: TensorBoard's thread would take time from training

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        if trainer.global_step in self.list_snapshot_steps(trainer.global_step):
            self.write(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        if trainer.global_step != self._last_written_step:
            self.write(trainer, pl_module)
