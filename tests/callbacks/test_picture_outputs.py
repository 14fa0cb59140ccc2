from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.callbacks import Budget, Evaluation, HeldOut, PictureCharts, TrainingGif
from nerf_lightning.callbacks.picture.charts import curve_chart, error_chart
from nerf_lightning.drawing.panels import narrowed

CURVE = [[0.5, 10, 20.0], [1.5, 100, 25.0], [4.0, 300, 31.0]]


# error.png, spectrum.png, curve.png


def test_error_chart_shows_error_of_each_pixel():
    truth = torch.zeros(20, 30, 3)
    rgb = truth.clone()
    rgb[3, 7] = torch.tensor([0.1, -0.2, 0.3])
    rgb[4] = 10 / 255
    figure = error_chart(rgb, truth, "sunset")
    (shown,) = figure.axes[0].images
    expected = np.zeros((20, 30))
    expected[3, 7], expected[4] = 0.2 * 255, 10
    np.testing.assert_allclose(shown.get_array(), expected, rtol=1e-5)
    low, high = shown.get_clim()
    assert low == 0 and 10 < high < 0.2 * 255, "one pixel far off does not darken the rest"


def test_curve_chart_runs_over_seconds_and_steps():
    figure = curve_chart(CURVE, "sunset")
    for axes, column in zip(figure.axes, (0, 1), strict=True):
        (line,) = axes.lines
        assert list(line.get_xdata()) == [point[column] for point in CURVE]
        assert list(line.get_ydata()) == [20, 25, 31]


@pytest.mark.parametrize("measured", [True, False])
def test_picture_charts_after_test_are_written(measured, clock, system, trainer_with, tmp_path: Path):
    charts, held_out = PictureCharts(), HeldOut([])
    held_out.curve = CURVE if measured else []
    charts.on_test_end(trainer_with(Budget(steps=1), Evaluation(), held_out, charts), system)
    names = {"error.png", "spectrum.png", *(["curve.png"] if measured else [])}
    assert {path.name for path in tmp_path.iterdir()} == names
    for name in names:
        picture = imageio.imread(tmp_path / name)
        assert min(picture.shape[:2]) > 300 and picture.std() > 1


# final.png, and what TensorBoard gets


@pytest.mark.parametrize(
    ("height", "width", "most", "size"), [(40, 60, 60, (40, 60)), (40, 60, 30, (20, 30)), (2, 60, 6, (1, 6))]
)
def test_narrowed_keeps_proportion(height: int, width: int, most: int, size: tuple[int, int]):
    assert narrowed(np.zeros((height, width, 3), np.uint8), most).shape == (*size, 3)


# training.gif


def frames_of(path: Path) -> list[tuple[int, int, tuple[int, int]]]:
    """Brightness, milliseconds and size of each frame."""
    frames = []
    with Image.open(path) as gif:
        assert gif.info["loop"] == 0, "for ever"
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append((gif.convert("L").getpixel((1, 1)), gif.info["duration"], gif.size))
    return frames


def test_training_gif_shows_snapshots_in_order(trainer_with, system, tmp_path: Path):
    gif, levels = TrainingGif(fps=5), [10, 200, 60, 120]
    gif.on_test_end(trainer_with(gif), system)
    assert not list(tmp_path.iterdir()), "no snapshots, no GIF"
    (tmp_path / "snapshots").mkdir()
    for number, level in reversed([*enumerate(levels)]):
        path = tmp_path / "snapshots" / f"step_{10 * number:07d}.png"
        imageio.imwrite(path, np.full((20, 30, 3), level, np.uint8))
    gif.on_test_end(trainer_with(gif), system)
    frames = frames_of(tmp_path / "training.gif")
    assert [level for level, _, _ in frames[:4]] == levels and {level for level, _, _ in frames[3:]} == {120}
    assert [duration for _, duration, _ in frames[:3]] == [200] * 3
    assert sum(duration for _, duration, _ in frames[3:]) == 600
    assert {size for _, _, size in frames} == {(30, 20)}
