"""Orbit: a turn around the subject as an animated GIF."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import lightning as L
import numpy as np
import torch
from jaxtyping import UInt8

from nerf_lightning.callbacks.attached import data_of
from nerf_lightning.callbacks.budget import Budget, Renders
from nerf_lightning.cameras import Cameras
from nerf_lightning.drawing.panels import panel, to_bytes, write_animation
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.options import AtLeast, FramesPerSecond
from nerf_lightning.utils.text import subsample

FILE = "orbit.gif"
"""Below the run folder."""
MAX_SIDE = 800
"""Longer one of a frame, in pixels."""


class Orbit(Renders):
    """Renders the scene's orbit after the test.

    Args:
        frames: how many of the orbit's views, evenly chosen, of at most `MAX_SIDE` pixels, or smaller where there is not time
            for them (see `Renders`); 0 makes no GIF.
        fps: frames a second.
    """

    def __init__(self, frames: Annotated[int, AtLeast(0)] = 60, fps: FramesPerSecond = 20):
        self.frames = frames
        self.fps = fps
        self._done = 0.0  # share of the frames

    def pixels_left(self, trainer: L.Trainer) -> float:
        return float(self.cameras(trainer).sizes.prod(1).sum()) * (1 - self._done)

    def cameras(self, trainer: L.Trainer) -> Cameras:
        """Of the frames, at the size for which there may be time."""
        orbit = data_of(trainer).scene.orbit
        chosen = orbit[torch.tensor(subsample(len(orbit), self.frames)).long()]
        return chosen.scaled(min(1.0, MAX_SIDE / orbit.longest))

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF3D) -> None:
        if self.frames == 0 or not trainer.is_global_zero:
            return
        full = self.cameras(trainer)
        scale = math.sqrt(self.share(trainer, pl_module))
        cameras = full.scaled(scale).to(pl_module.device)
        if scale < 1:
            size = f"{len(full)} frames of {cameras.width}x{cameras.height}"
            print(
                f"{FILE}: {size}, so that rendering takes no longer than training; nerf_lightning render takes any size"
            )
        with atomic(Path(trainer.default_root_dir) / FILE) as temporary:
            write_animation(temporary, self._draw(trainer, pl_module, cameras), 1 / self.fps)

    def _draw(self, trainer: L.Trainer, system: NeRF3D, cameras: Cameras) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        plan, caption = Budget.of(trainer).plan, f"{data_of(trainer).scene.name}, step {trainer.global_step}"
        for view in range(len(cameras)):
            before = plan.spent
            with plan.rendering(f"orbit, frame {view + 1} of {len(cameras)}"):
                rgb = system.render(cameras.view_rays(view)).rgb
                image = to_bytes(rgb.view(cameras.height, cameras.width, 3))
            plan.note(len(rgb), plan.spent - before)
            self._done = (view + 1) / len(cameras)
            yield panel([image], caption)
