"""Orbit: an animated GIF of a camera path around the subject."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import lightning as L
import numpy as np
import torch
from jaxtyping import UInt8

from nerf_lightning.callbacks.budget import Budget, RenderingCallback
from nerf_lightning.callbacks.trainer_access import get_datamodule
from nerf_lightning.cameras import Cameras
from nerf_lightning.drawing.panels import make_panel, to_uint8, write_animation
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.files import atomic_write
from nerf_lightning.utils.option_checks import FramesPerSecond, Ge
from nerf_lightning.utils.text import subsample

ORBIT_FILE = "orbit.gif"
MAX_FRAME_SIDE = 800
"""Longer side of a frame, in pixels."""


class Orbit(RenderingCallback):
    """Renders the scene's orbit after the test.

    Args:
        frames: views of the orbit, evenly spaced, of at most `MAX_FRAME_SIDE` pixels, smaller where time is short (see
            `RenderingCallback`); 0 makes no GIF.
        fps: frames per second.
    """

    def __init__(self, frames: Annotated[int, Ge(0)] = 60, fps: FramesPerSecond = 20):
        self.frames = frames
        self.fps = fps
        self._done_fraction = 0.0  # of the frames

    def count_remaining_pixels(self, trainer: L.Trainer) -> float:
        return float(self.select_cameras(trainer).sizes.prod(1).sum()) * (1 - self._done_fraction)

    def select_cameras(self, trainer: L.Trainer) -> Cameras:
        """Cameras of the frames, at full size."""
        orbit = get_datamodule(trainer).scene.orbit
        chosen = orbit[torch.tensor(subsample(len(orbit), self.frames)).long()]
        return chosen.rescale(min(1.0, MAX_FRAME_SIDE / orbit.max_side))

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF3D) -> None:
        if self.frames == 0 or not trainer.is_global_zero:
            return
        full = self.select_cameras(trainer)
        scale = math.sqrt(self.compute_affordable_fraction(trainer, pl_module))
        cameras = full.rescale(scale).to(pl_module.device)
        if scale < 1:
            frames = f"{ORBIT_FILE}: {len(full)} frames of {cameras.width}x{cameras.height}"
            print(f"{frames}, so that rendering takes no longer than training; nerf_lightning render takes any size")
        with atomic_write(Path(trainer.default_root_dir) / ORBIT_FILE) as temporary:
            write_animation(temporary, self._render_frames(trainer, pl_module, cameras), 1 / self.fps)

    def _render_frames(
        self, trainer: L.Trainer, system: NeRF3D, cameras: Cameras
    ) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
        render_timer = Budget.find(trainer).render_timer
        caption = f"{get_datamodule(trainer).scene.name}, step {trainer.global_step}"
        for view in range(len(cameras)):
            before = render_timer.seconds
            with render_timer.measure(f"orbit, frame {view + 1} of {len(cameras)}"):
                rgb = system.render(cameras.generate_view_rays(view), width=cameras.width).rgb
                image = to_uint8(rgb.view(cameras.height, cameras.width, 3))
            render_timer.add_timing(len(rgb), render_timer.seconds - before)
            self._done_fraction = (view + 1) / len(cameras)
            yield make_panel([image], caption)
