"""Enlarge: the field on a finer grid than it was trained on, beside bicubic interpolation."""

from pathlib import Path

import cv2
import lightning as L

from nerf_lightning.callbacks.attached import ChecksData, data_of
from nerf_lightning.callbacks.picture.baselines import quality_of, words
from nerf_lightning.dataset import Picture, PixelDataModule, RayDataModule, pixel_grid
from nerf_lightning.drawing.panels import panel, to_bytes, write_png
from nerf_lightning.errors import InputError
from nerf_lightning.system import NeRF2D
from nerf_lightning.utils.files import write_json

MAX_PIXELS = 1 << 28


class Enlarge(ChecksData):
    """Renders a 2D field at another scale after the test: enlarged.png alone, enlarged_panel.png beside bicubic.

    If the picture was shrunk for training (`dataset.max_side`) or is the built-in one, the true larger picture is known, and
    both are compared with it: printed, and in enlarged.json.

    Args:
        scale: factor on width and height; None does nothing.

    Raises:
        InputError: from `check`, where scale is not above 0, or makes a picture beyond `MAX_PIXELS`.
    """

    def __init__(self, scale: float | None = None):
        self.scale = scale

    def check(self, data: RayDataModule | PixelDataModule) -> None:
        if self.scale is None or not isinstance(data, PixelDataModule):
            return
        width, height = data.scene.size
        if not (self.scale > 0 and self.scale**2 * width * height <= MAX_PIXELS):
            expected = f"above 0, for a picture of at most {MAX_PIXELS} pixels"
            raise InputError("render.scale", "", str(self.scale), expected)

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF2D) -> None:
        scene, folder = data_of(trainer).scene, Path(trainer.default_root_dir)
        if self.scale is None or not isinstance(scene, Picture) or not trainer.is_global_zero:
            return
        width, height = (max(1, round(side * self.scale)) for side in scene.size)
        rgb = pl_module.colours(pixel_grid(height, width).to(pl_module.device)).cpu()
        field, truth = to_bytes(rgb.view(height, width, 3)), scene.at(width, height)
        method = cv2.INTER_CUBIC if self.scale > 1 else cv2.INTER_AREA  # bicubic alone would skip pixels when shrinking
        bicubic = cv2.resize(scene.image.numpy(), (width, height), interpolation=method)
        scores = {"scale": self.scale, "width": width, "height": height, "field": None, "bicubic": None}
        names, shown = "bicubic | field", [bicubic, field]
        text = "no larger original to judge by (dataset.max_side=... shrinks a picture for training and keeps it)"
        if truth is not None:
            scores |= {"field": quality_of(field, truth.numpy()), "bicubic": quality_of(bicubic, truth.numpy())}
            names, shown = "bicubic | field | truth", [*shown, truth.numpy()]
            text = f"field {words(scores['field'])}, bicubic {words(scores['bicubic'])}"
        write_png(folder / "enlarged.png", field)
        write_png(folder / "enlarged_panel.png", panel(shown, f"{names}    {width}x{height}"))
        write_json(folder / "enlarged.json", scores)
        print(f"{self.scale:g} times as large ({width}x{height}): {text}")
