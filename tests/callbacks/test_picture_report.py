import functools
import json
import math
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.callbacks import Budget, Evaluation, PeriodicValidation, PictureReport, PictureUpscaling
from nerf_lightning.callbacks.picture_report import (
    compare_with_jpeg,
    compute_psnr,
    downsample_to_bytes,
    encode_jpegs,
    format_psnr,
    plot_error_map,
    plot_psnr_curve,
)
from nerf_lightning.datamodules import build_picture_data
from nerf_lightning.dataset import PixelDataModule
from nerf_lightning.dataset.picture import make_builtin_picture
from nerf_lightning.drawing.panels import limit_width
from nerf_lightning.model import PictureField
from nerf_lightning.system import NeRF2D, constant

CURVE = [[0.5, 10, 20.0], [1.5, 100, 25.0], [4.0, 300, 31.0]]


def test_plot_error_map_shows_error_of_each_pixel():
    truth = torch.zeros(20, 30, 3)
    rgb = truth.clone()
    rgb[3, 7] = torch.tensor([0.1, -0.2, 0.3])
    rgb[4] = 10 / 255
    figure = plot_error_map(rgb, truth, "sunset")
    (shown,) = figure.axes[0].images
    expected = np.zeros((20, 30))
    expected[3, 7], expected[4] = 0.2 * 255, 10
    np.testing.assert_allclose(shown.get_array(), expected, rtol=1e-5)
    low, high = shown.get_clim()
    assert low == 0 and 10 < high < 0.2 * 255, "one pixel far off does not darken the rest"


def test_plot_psnr_curve_has_seconds_and_steps():
    figure = plot_psnr_curve(CURVE, "sunset")
    for axes, column in zip(figure.axes, (0, 1), strict=True):
        (line,) = axes.lines
        assert list(line.get_xdata()) == [point[column] for point in CURVE]
        assert list(line.get_ydata()) == [20, 25, 31]


def test_picture_report_after_test_writes_charts(clock, system, trainer_with, tmp_path: Path):
    report, validation = PictureReport(), PeriodicValidation([])
    validation.curve = CURVE
    report.on_test_end(trainer_with(Budget(steps=1), Evaluation(), validation, report), system)
    names = {"error.png", "spectrum.png", "curve.png"}
    assert {path.name for path in tmp_path.iterdir()} == {*names, "baselines.json"}, "no snapshots, no GIF"
    for name in names:
        picture = imageio.imread(tmp_path / name)
        assert min(picture.shape[:2]) > 300 and picture.std() > 1


@pytest.mark.parametrize(("size", "most", "expected"), [((4, 6), 6, (4, 6)), ((4, 6), 3, (2, 3)), ((2, 60), 6, (1, 6))])
def test_limit_width_wide_image_keeps_aspect_ratio(size: tuple[int, int], most: int, expected: tuple[int, int]):
    assert limit_width(np.zeros((*size, 3), np.uint8), most).shape == (*expected, 3)


def frames_of(path: Path) -> list[tuple[int, int, tuple[int, int]]]:
    """Brightness, milliseconds and size of each frame."""
    frames = []
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0, "for ever"
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append((gif.convert("L").getpixel((1, 1)), gif.info["duration"], gif.size))
    return frames


def test_write_gif_shows_snapshots_in_order(tmp_path: Path):
    levels = [10, 200, 60, 120]
    files = [tmp_path / f"step_{number}.png" for number in range(4)]
    for path, level in zip(files, levels, strict=True):
        imageio.imwrite(path, np.full((20, 30, 3), level, np.uint8))
    PictureReport(fps=5).write_gif(files, tmp_path / "training.gif")
    frames = frames_of(tmp_path / "training.gif")
    assert [level for level, _, _ in frames[:4]] == levels and {level for level, _, _ in frames[3:]} == {120}
    assert [duration for _, duration, _ in frames[:3]] == [200] * 3
    assert sum(duration for _, duration, _ in frames[3:]) == 600
    assert {size for _, _, size in frames} == {(30, 20)}


@pytest.fixture(scope="module")
def sunset() -> np.ndarray:
    return make_builtin_picture(40).numpy()


def test_compute_psnr_equal_images_is_infinite(sunset):
    assert compute_psnr(sunset, sunset.copy()) == math.inf and format_psnr(math.inf) == "without loss"
    off_by_one = np.where(sunset > 127, sunset - 1, sunset + 1).astype(np.uint8)
    assert compute_psnr(sunset, off_by_one) == pytest.approx(20 * math.log10(255), abs=1e-4)


def test_downsample_to_bytes_keeps_aspect_ratio(sunset):
    wide = sunset[:20]
    assert [downsample_to_bytes(wide, 2400 // n**2)["width"] for n in (1, 2, 4, 5)] == [40, 20, 10, 8]
    limits = (30, 100, 700, 1500, 2399)
    found = [downsample_to_bytes(wide, limit) for limit in limits]
    for one, limit in zip(found, limits, strict=True):
        assert one["bytes"] == 3 * one["width"] * one["height"] <= limit
    qualities = [one["psnr"] for one in found]
    assert qualities == sorted(qualities) and qualities[-1] > qualities[0] + 3


@pytest.mark.parametrize("size", [2000, 100])
def test_compare_with_jpeg_matches_bytes(size, sunset):
    found = compare_with_jpeg(sunset, size)
    small = [one["psnr"] for one in encode_jpegs(sunset) if one["bytes"] <= size]
    assert (found["bytes"], found["picture_bytes"]) == (size, 4800)
    assert (found["jpeg"]["psnr"] == max(small) if small else found["jpeg"] is None) and (size > 100) == bool(small)
    assert found["bicubic"] == downsample_to_bytes(sunset, size)


class Ramp(PictureField):
    """Red grows to the right, green downward."""

    def __init__(self, size: tuple[int, int]):
        super().__init__(size)
        self.blue = torch.nn.Parameter(torch.tensor(0.5))

    def forward(self, uv: torch.Tensor) -> torch.Tensor:
        return torch.cat([uv, self.blue.expand(len(uv), 1)], dim=1)


def ramp(width: int, height: int) -> np.ndarray:
    """`Ramp` rendered at a given size."""
    red, green = ((np.arange(n) + 0.5) / n for n in (width, height))
    colors = np.stack(np.broadcast_arrays(red, green[:, None], 0.5), axis=-1)
    return np.rint(colors.astype(np.float32) * 255).astype(np.uint8)


@pytest.fixture
def upscale(trainer_with, tmp_path: Path):
    """Enlarges a `Ramp` that stands for what a field has learned of a dataset; returns enlarged.json."""

    def call(data: PixelDataModule, scale: float | None) -> dict:
        trainer, system = trainer_with(), NeRF2D(Ramp(data.scene.size), functools.partial(torch.optim.SGD), constant)
        trainer.datamodule = data
        PictureUpscaling(scale).on_test_end(trainer, system)
        return json.loads((tmp_path / "enlarged.json").read_text())

    return call


@pytest.mark.parametrize(("scale", "side"), [(0.5, 12), (2.65, 64)])
def test_upscale_builtin_picture_is_compared_with_truth(scale, side, upscale, tmp_path: Path):
    scores = upscale(build_picture_data(max_side=24), scale)
    made = imageio.imread(tmp_path / "enlarged.png")
    truth, small = make_builtin_picture(side).numpy(), make_builtin_picture(24).numpy()
    assert np.array_equal(made, ramp(side, side)), "a field is seen at the finer pixels' centers"
    method = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    bicubic = compute_psnr(cv2.resize(small, (side, side), interpolation=method), truth)
    size = {"scale": scale, "width": side, "height": side}
    assert scores == {**size, "field": compute_psnr(ramp(side, side), truth), "bicubic": bicubic}


def test_upscale_without_larger_original_gives_no_scores(upscale, tmp_path: Path, capsys):
    photo = np.random.default_rng(0).integers(0, 256, (20, 40, 3)).astype(np.uint8)
    imageio.imwrite(tmp_path / "photo.png", photo)
    scores = upscale(build_picture_data(str(tmp_path / "photo.png")), 3)
    assert scores["field"] is None and scores["bicubic"] is None
    assert imageio.imread(tmp_path / "enlarged.png").shape == (60, 120, 3)
    assert "3 times as large (120x60): no larger original" in capsys.readouterr().out
