"""TrainingGif: the snapshots of a training, one after the other."""

from pathlib import Path

import cv2
import imageio.v3 as imageio
import lightning as L

from nerf_lightning.callbacks.snapshots import FOLDER
from nerf_lightning.drawing.panels import narrowed, write_animation
from nerf_lightning.system import System
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.options import Count, FramesPerSecond


class TrainingGif(L.Callback):
    """Makes training.gif of the snapshots, where there are any, after training.

    Args:
        fps: frames a second; the last one stays for three.
        width: most pixels across; wider snapshots are shrunk.
    """

    def __init__(self, fps: FramesPerSecond = 3, width: Count = 640):
        self.fps = fps
        self.width = width

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        folder = Path(trainer.default_root_dir)
        files = sorted((folder / FOLDER).glob("step_*.png"))
        if not files or not trainer.is_global_zero:
            return
        height, width, _ = narrowed(imageio.imread(files[-1]), self.width).shape
        pictures = (imageio.imread(file) for file in [*files, files[-1], files[-1]])
        frames = (cv2.resize(one, (width, height), interpolation=cv2.INTER_AREA) for one in pictures)
        with atomic(folder / "training.gif") as temporary:
            write_animation(temporary, frames, 1 / self.fps)
