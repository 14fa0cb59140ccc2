"""Snapshots: what the field looks like along the way."""

from collections.abc import Iterator
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import ChecksData, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.render_plan import Need, Renders
from nerf_lightning.callbacks.rendering import share_of
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.dataset.subset import thin
from nerf_lightning.drawing.panels import narrowed, result_panel, to_bytes, write_png
from nerf_lightning.errors import InputError
from nerf_lightning.system import System

LOGGED_WIDTH = 640
"""Widest picture for TensorBoard, in pixels: it takes 0.1 s for each megabyte."""
FOLDER, FINAL, TRUTH = "snapshots", "final.png", "truth.png"
"""Below the run folder: all snapshots, the latest render alone, and what it should look like, which is written once."""
MIN_PIXELS, MAX_PIXELS = 1 << 13, 800 * 800
"""Of a snapshot of a scene, which is for looking at."""


def log_spaced() -> Iterator[int]:
    """10, 20, 50, 100, ...: the default steps of snapshots."""
    return (digit * 10**power for power in count(1) for digit in (1, 2, 5))


class Snapshots(ChecksData, Renders):
    """Writes truth, render and depth of one held-out view as PNG and to TensorBoard, and once more at the end.

    Of views beyond `MAX_PIXELS`, and where there is not time for all (see `RenderPlan`),
    every n-th row and column is rendered.

    Args:
        steps: after which steps; None means 10, 20, 50, 100, 200, 500, ...
        view: index of the held-out view.

    Raises:
        InputError: from `check`, if there is no such view.
    """

    def __init__(self, steps: list[int] | None = None, view: int = 0):
        self.steps = None if steps is None else frozenset(steps)
        self.view = view
        self._written: int | None = None  # the step of the latest

    def due(self, step: int) -> bool:
        return step in (self.steps if self.steps is not None else takewhile(lambda one: one <= step, log_spaced()))

    def check(self, data: RayDataModule | PixelDataModule) -> None:
        views = data.held_out_views
        if not 0 <= self.view < views:
            raise InputError("callbacks.snapshots.view", "", str(self.view), f"a held-out view from 0 to {views - 1}")

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        step, progress = trainer.global_step, Budget.of(trainer).progress(trainer.global_step)
        last = step / progress if progress else step
        steps = sorted(self.steps) if self.steps is not None else takewhile(lambda one: one <= last, log_spaced())
        left = {one for one in steps if step <= one <= last} | {round(last)}
        count = len(left - {self._written})
        return {"snapshots": Need(count * self.most_pixels(trainer), count * MIN_PIXELS)}

    def path(self, trainer: L.Trainer) -> Path:
        """Of the snapshot of this step."""
        return Path(trainer.default_root_dir) / FOLDER / f"step_{trainer.global_step:07d}.png"

    def most_pixels(self, trainer: L.Trainer) -> int:
        """Of a snapshot for which there is time."""
        data = data_of(trainer)
        pixels = data.pixels_held_out(self.view)
        return pixels if isinstance(data, PixelDataModule) else min(pixels, MAX_PIXELS)

    def write(self, trainer: L.Trainer, pl_module: System) -> None:
        if not trainer.is_global_zero:
            return
        budget, data, step = Budget.of(trainer), data_of(trainer), trainer.global_step
        most = share_of(trainer, pl_module, "snapshots") * self.most_pixels(trainer)
        subset = thin(data.pixels_held_out(self.view), max(MIN_PIXELS, most))
        with budget.rendering(trainer, "snapshot"):
            (result,) = pl_module.evaluate_held_out(data, [self.view], subset)
        budget.plan.note(result.pixels, result.seconds)
        self._written = step
        with budget.paused():  # not `rendering`: a signal may not break what others write on
            caption = f"{data.scene.name}, step {step}, {budget.seconds:.0f} s, {result.psnr:.2f} dB"
            picture = result_panel(result, caption)
            write_png(self.path(trainer), picture)
            write_png(Path(trainer.default_root_dir) / FINAL, to_bytes(result.rgb))
            truth = Path(trainer.default_root_dir) / TRUTH
            if not truth.exists():
                write_png(truth, to_bytes(result.truth))
            if isinstance(trainer.logger, L.pytorch.loggers.TensorBoardLogger):
                trainer.logger.experiment.add_image(
                    "images/view", narrowed(picture, LOGGED_WIDTH), step, dataformats="HWC"
                )
                trainer.logger.experiment.flush()  # while paused: TensorBoard's thread would take time from training

    def on_train_start(self, trainer: L.Trainer, pl_module: System) -> None:
        """What an interruption left undone is drawn where it was due."""
        if trainer.global_step and not self.path(trainer).exists():
            self.on_train_batch_end(trainer, pl_module)

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *batch: Any) -> None:
        if self.due(trainer.global_step):
            self.write(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        if not self.path(trainer).exists():
            self.write(trainer, pl_module)
