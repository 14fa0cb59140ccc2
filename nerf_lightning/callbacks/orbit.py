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
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.rendering import Renders
from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset import Scene
from nerf_lightning.drawing.panels import panel, to_bytes, write_animation
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.options import AtLeast, FramesPerSecond
from nerf_lightning.utils.text import subsample

FILE = "orbit.gif"
"""Below the run folder."""
MAX_FRAMES, MAX_SIDE = 60, 800
"""By default; the side is the longer one of a frame, in pixels."""


class Orbit(Renders):
    """Renders the scene's orbit after the test.

    Args:
        frames: how many of the orbit's views, evenly chosen, at their full size; 0 makes no GIF. None takes 60 of at most
            `MAX_SIDE` pixels, or smaller ones where there is not time for them (see `Renders`).
        fps: frames a second.
    """

    def __init__(self, frames: Annotated[int, AtLeast(0)] | None = None, fps: FramesPerSecond = 20):
        self.frames = frames
        self.fps = fps
        self.in_full = frames is not None
        self._done = 0.0  # share of the frames

    def pixels_left(self, trainer: L.Trainer) -> float:
        return float(self.cameras(trainer).sizes.prod(1).sum()) * (1 - self._done)

    def cameras(self, trainer: L.Trainer) -> Cameras:
        """Of the frames, at the size for which there may be time."""
        scene = data_of(trainer).scene
        assert isinstance(scene, Scene)  # NeRF3D trains on nothing else
        count = MAX_FRAMES if self.frames is None else self.frames
        chosen = scene.orbit[torch.tensor(subsample(len(scene.orbit), count), dtype=torch.long)]
        return chosen if self.in_full else chosen.scaled(min(1.0, MAX_SIDE / scene.orbit.longest))

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF3D) -> None:
        if self.frames == 0 or not trainer.is_global_zero:
            return
        full = self.cameras(trainer)
        scale = 1.0 if self.in_full else math.sqrt(self.share(trainer, pl_module))
        cameras = full.scaled(scale).to(pl_module.device)
        if scale < 1:
            print(
                f"{FILE}: {len(full)} frames of {cameras.width}x{cameras.height}, so that rendering takes no longer than"
                f" training; callbacks.orbit.frames={len(full)} draws them at full size"
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
