"""Orbit: a turn around the subject as an animated GIF."""

import math
import time
from collections.abc import Iterator
from pathlib import Path

import lightning as L
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.budget import Budget
from nerf_lightning.callbacks.progress import Progress
from nerf_lightning.dataset import Scene
from nerf_lightning.drawing.panels import panel, to_bytes, write_animation
from nerf_lightning.errors import InputError
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.evenly import evenly
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.options import FramesPerSecond

MOST, FEWEST, SMALLEST = 60, 12, 0.25
"""By default: most and fewest frames of an orbit, and the smallest factor on their size."""


class Orbit(L.Callback):
    """Renders the scene's orbit after the test.

    Args:
        path: the GIF, below the run folder.
        frames: how many of the orbit's views, evenly chosen; 0 makes no GIF. None takes 60, or fewer and smaller ones if
            drawing them would take longer than training took and longer than half a minute.
        fps: frames a second.

    Raises:
        InputError: where frames < 0 or fps <= 0.
    """

    def __init__(self, path: str = "orbit.gif", frames: int | None = None, fps: FramesPerSecond = 20):
        if frames is not None and frames < 0:
            raise InputError("callbacks.orbit.frames", "", str(frames), "0 (no orbit) or more")
        if fps <= 0:
            raise InputError("callbacks.orbit.fps", "", str(fps), "more than 0")
        self.path = path
        self.frames = frames
        self.fps = fps

    def setup(self, trainer: L.Trainer, pl_module: NeRF3D, stage: str) -> None:
        progress = attached(trainer, Progress)
        if progress is not None and stage == "fit":
            progress.later_views += MOST if self.frames is None else self.frames

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF3D) -> None:
        if self.frames == 0 or not trainer.is_global_zero:
            return
        scene = data_of(trainer).scene
        assert isinstance(scene, Scene)  # NeRF3D trains on nothing else
        cameras = scene.orbit.to(pl_module.device)
        progress = attached(trainer, Progress)

        def picture(view: int) -> UInt8[np.ndarray, "H W 3"]:
            rgb = pl_module.render(cameras.view_rays(view)).rgb
            image = to_bytes(rgb.view(cameras.height, cameras.width, 3).cpu())
            return panel([image], f"{scene.name}, step {trainer.global_step}")

        count, start = min(MOST if self.frames is None else self.frames, len(cameras)), time.perf_counter()
        drawn = [picture(evenly(len(cameras), count)[0])]
        if self.frames is None:
            one = time.perf_counter() - start
            fitting, shrink = affordable(count, one, Budget.of(trainer).drawing_seconds(trainer.global_step))
            if fitting < count or shrink < 1:
                smaller = cameras.scaled(shrink)
                print(
                    f"{self.path}: {fitting} frames of {smaller.width}x{smaller.height}, as one of "
                    f"{cameras.width}x{cameras.height} takes {one:.1f} s; callbacks.orbit.frames={count} draws all"
                )
                count, cameras, drawn = fitting, smaller, []

        def frames() -> Iterator[UInt8[np.ndarray, "H W 3"]]:
            yield from drawn
            for number, view in enumerate(evenly(len(cameras), count)[len(drawn) :], len(drawn) + 1):
                yield picture(view)
                if progress is not None:
                    progress.frame(number, count)

        with atomic(Path(trainer.default_root_dir) / self.path) as temporary:
            write_animation(temporary, frames(), 1 / self.fps)


def affordable(frames: int, seconds: float, allowed: float) -> tuple[int, float]:
    """How many frames to draw, and the factor on their size, so that all fit into the time allowed.

    Args:
        frames: at most this many.
        seconds: for one at full size; proportional to its pixels.
        allowed: seconds for all of them.
    """
    count = min(frames, max(int(allowed / seconds), FEWEST))
    return count, min(1.0, max(SMALLEST, math.sqrt(allowed / (count * seconds))))
