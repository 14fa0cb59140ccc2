"""Orbit: a turn around the subject as an animated GIF."""

from pathlib import Path

import imageio.v3 as imageio
import lightning as L
import numpy as np

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.panels import panel, to_bytes
from nerf_lightning.callbacks.progress import Progress
from nerf_lightning.dataset import Scene
from nerf_lightning.errors import InputError
from nerf_lightning.evenly import evenly
from nerf_lightning.files import atomic
from nerf_lightning.system import NeRF3D


class Orbit(L.Callback):
    """Renders the scene's orbit after the test.

    Args:
        path: the GIF, below the run folder.
        frames: how many of the orbit's views, evenly chosen; 0 makes no GIF.
        fps: frames a second.

    Raises:
        InputError: where frames < 0 or fps <= 0.
    """

    def __init__(self, path: str = "orbit.gif", frames: int = 60, fps: float = 20):
        if frames < 0:
            raise InputError("callbacks.orbit.frames", "", str(frames), "0 (no orbit) or more")
        if fps <= 0:
            raise InputError("callbacks.orbit.fps", "", str(fps), "more than 0")
        self.path = path
        self.frames = frames
        self.fps = fps

    def setup(self, trainer: L.Trainer, pl_module: NeRF3D, stage: str) -> None:
        progress = attached(trainer, Progress)
        if progress is not None and stage == "fit":
            progress.later_views += self.frames

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF3D) -> None:
        if self.frames == 0 or not trainer.is_global_zero:
            return
        scene = data_of(trainer).scene
        assert isinstance(scene, Scene)  # NeRF3D trains on nothing else
        cameras = scene.orbit.to(pl_module.device)
        progress = attached(trainer, Progress)
        pictures = []
        for view in evenly(len(cameras), self.frames):
            rgb = pl_module.render(cameras.view_rays(view)).rgb
            image = to_bytes(rgb.view(cameras.height, cameras.width, 3).cpu())
            pictures.append(panel([image], f"{scene.name}, step {trainer.global_step}"))
            if progress is not None:
                progress.frame(len(pictures), self.frames)
        with atomic(Path(trainer.default_root_dir) / self.path) as temporary:
            imageio.imwrite(temporary, np.stack(pictures), duration=1000 / self.fps, loop=0)
