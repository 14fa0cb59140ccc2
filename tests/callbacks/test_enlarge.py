import functools
import json
import math
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.callbacks import Enlarge
from nerf_lightning.callbacks.picture.baselines import quality_of
from nerf_lightning.dataset import Picture, PixelDataModule
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.errors import InputError
from nerf_lightning.model import PictureField
from nerf_lightning.sources import from_picture
from nerf_lightning.system import NeRF2D, constant


class Ramp(PictureField):
    """Red grows to the right, green downward."""

    def __init__(self, size: tuple[int, int]):
        super().__init__(size)
        self.blue = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        return torch.cat([uv, self.blue.expand(len(uv), 1)], dim=1)


def ramp(width: int, height: int) -> np.ndarray:
    """What `Ramp` looks like in so many pixels."""
    red, green = ((np.arange(n) + 0.5) / n for n in (width, height))
    colours = np.stack(np.broadcast_arrays(red, green[:, None], 0.5), axis=-1)
    return np.rint(colours.astype(np.float32) * 255).astype(np.uint8)


@pytest.fixture
def enlarge(trainer_with):
    """Enlarges a `Ramp` that stands for what a field has learned of a dataset."""

    def call(data: PixelDataModule, scale: float | None) -> None:
        trainer, system = trainer_with(), NeRF2D(Ramp(data.scene.size), functools.partial(torch.optim.SGD), constant)
        trainer.datamodule = data
        callback = Enlarge(scale)
        callback.check(data)
        callback.on_test_end(trainer, system)

    return call


def photo(folder: Path, width: int, height: int) -> Path:
    path = folder / "photo.png"
    imageio.imwrite(path, np.random.default_rng(0).integers(0, 256, (height, width, 3)).astype(np.uint8))
    return path


@pytest.mark.parametrize(("scale", "side"), [(2, 48), (0.5, 12), (2.65, 64)])
def test_enlarge_built_in_picture_is_compared_with_truth(scale, side, enlarge, tmp_path: Path, capsys):
    enlarge(from_picture(max_side=24), scale)
    made = imageio.imread(tmp_path / "enlarged.png")
    truth, small = builtin_picture(side).numpy(), builtin_picture(24).numpy()
    assert np.array_equal(made, ramp(side, side)), "a field is seen at the finer pixels' centres"
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    scores = {
        "field": quality_of(ramp(side, side), truth),
        "bicubic": quality_of(cv2.resize(small, (side, side), interpolation=method), truth),
    }
    assert json.loads((tmp_path / "enlarged.json").read_text()) == {
        "scale": scale, "width": side, "height": side, **scores
    }  # fmt: skip
    assert f"field {scores['field']:.2f} dB, bicubic {scores['bicubic']:.2f} dB" in capsys.readouterr().out


@pytest.mark.parametrize("max_side", [None, 20])
def test_enlarge_without_larger_original_gives_no_scores(max_side, enlarge, tmp_path: Path, capsys):
    enlarge(from_picture(str(photo(tmp_path, 40, 20)), max_side=max_side), 3)
    scores = json.loads((tmp_path / "enlarged.json").read_text())
    assert scores["field"] is None and scores["bicubic"] is None
    assert imageio.imread(tmp_path / "enlarged.png").shape == (scores["height"], scores["width"], 3)
    told = capsys.readouterr().out
    assert f"3 times as large ({scores['width']}x{scores['height']}): no larger original" in told and "dB" not in told


@pytest.mark.parametrize(
    ("scale", "fits"), [(2.0**12, True), (2.0**12 + 1, False), (0.0, False), (-2.0, False), (math.nan, False)]
)
def test_enlarge_scale_out_of_range_is_refused_before_training(scale: float, fits: bool):
    data = PixelDataModule(Picture("square", "made", torch.zeros(4, 4, 3, dtype=torch.uint8)))
    if fits:
        Enlarge(scale).check(data)
    else:
        with pytest.raises(InputError, match="render.scale"):
            Enlarge(scale).check(data)
