"""Snapshots: what the field looks like along the way."""

from pathlib import Path
from typing import Any

import lightning as L

from nerf_lightning.callbacks.attached import ChecksData, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.drawing.panels import narrowed, result_panel, to_bytes, write_png
from nerf_lightning.errors import InputError
from nerf_lightning.system import System

LOGGED_WIDTH = 640
"""Widest picture for TensorBoard, in pixels: it takes 0.1 s for each megabyte."""


def log_spaced(step: int) -> bool:
    """1, 2, 5, 10, 20, 50, ...: the default times of snapshots."""
    digits = str(step)
    return digits[0] in "125" and not digits[1:].strip("0")


class Snapshots(ChecksData):
    """Writes truth, render and depth of one held-out view as PNG and to TensorBoard, and once more at the end.

    `final` is the latest render alone.

    Args:
        folder: where the PNGs go, below the run folder.
        steps: after which steps; None means 10, 20, 50, 100, 200, 500, ...
        view: index of the held-out view.
        final: the latest render, below the run folder.

    Raises:
        InputError: from `check`, if there is no such view.
    """

    def __init__(
        self, folder: str = "snapshots", steps: list[int] | None = None, view: int = 0, final: str = "final.png"
    ):
        self.folder = folder
        self.final = final
        self.steps = None if steps is None else frozenset(steps)
        self.view = view

    def due(self, step: int) -> bool:
        return step in self.steps if self.steps is not None else step >= 10 and log_spaced(step)

    def check(self, data: RayDataModule | PixelDataModule) -> None:
        views = data.held_out_views
        if not 0 <= self.view < views:
            raise InputError("callbacks.snapshots.view", "", str(self.view), f"a held-out view from 0 to {views - 1}")

    def write(self, trainer: L.Trainer, pl_module: System) -> None:
        if not trainer.is_global_zero:
            return
        with Budget.of(trainer).paused():
            data, step = data_of(trainer), trainer.global_step
            (result,) = pl_module.evaluate_held_out(data, [self.view])
            caption = f"{data.scene.name}, step {step}, {Budget.of(trainer).seconds:.0f} s, {result.psnr:.2f} dB"
            picture = result_panel(result, caption)
            write_png(Path(trainer.default_root_dir) / self.folder / f"step_{step:07d}.png", picture)
            write_png(Path(trainer.default_root_dir) / self.final, to_bytes(result.rgb))
            if isinstance(trainer.logger, L.pytorch.loggers.TensorBoardLogger):
                trainer.logger.experiment.add_image(
                    "snapshot", narrowed(picture, LOGGED_WIDTH), step, dataformats="HWC"
                )
                trainer.logger.experiment.flush()  # while paused: TensorBoard's thread would take time from training

    def on_train_batch_end(
        self, trainer: L.Trainer, pl_module: System, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        if self.due(trainer.global_step):
            self.write(trainer, pl_module)

    def on_train_end(self, trainer: L.Trainer, pl_module: System) -> None:
        if not self.due(trainer.global_step):
            self.write(trainer, pl_module)
