"""TrainingGif: the snapshots of a training, one after the other."""

from pathlib import Path

import cv2
import imageio.v3 as imageio
import lightning as L

from nerf_lightning.callbacks.attached import attached
from nerf_lightning.callbacks.snapshots import Snapshots
from nerf_lightning.drawing.panels import narrowed, write_animation
from nerf_lightning.system import System
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.options import Count, FramesPerSecond


class TrainingGif(L.Callback):
    """Makes a GIF of the snapshots after training.

    Args:
        path: the GIF, below the run folder.
        fps: frames a second; the last one stays for three.
        width: most pixels across; wider snapshots are shrunk.
    """

    def __init__(self, path: str = "training.gif", fps: FramesPerSecond = 3, width: Count = 640):
        self.path = path
        self.fps = fps
        self.width = width

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        snapshots = attached(trainer, Snapshots)
        if snapshots is None or not trainer.is_global_zero:
            return
        files = sorted((Path(trainer.default_root_dir) / snapshots.folder).glob("step_*.png"))
        if not files:
            return
        pictures = (narrowed(imageio.imread(file), self.width) for file in [*files, files[-1], files[-1]])
        height, width, _ = narrowed(imageio.imread(files[-1]), self.width).shape
        frames = (cv2.resize(one, (width, height), interpolation=cv2.INTER_NEAREST) for one in pictures)
        with atomic(Path(trainer.default_root_dir) / self.path) as temporary:
            write_animation(temporary, frames, 1 / self.fps)
