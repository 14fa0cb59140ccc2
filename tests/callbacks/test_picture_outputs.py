from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.callbacks import PictureCharts, Results, TrainingGif
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
    assert figure.axes[0].get_title() == "sunset"


def test_curve_chart_runs_over_seconds_and_steps():
    figure = curve_chart(CURVE, "sunset")
    for axes, column in zip(figure.axes, (0, 1), strict=True):
        (line,) = axes.lines
        assert list(line.get_xdata()) == [point[column] for point in CURVE]
        assert list(line.get_ydata()) == [20, 25, 31]
    assert [axes.get_xlabel() for axes in figure.axes] == ["training seconds", "step"]


def results_with(curve: list[list[float]]) -> Results:
    results = Results("results.json", "grey", 0)
    results.summary = {"curve": curve}
    return results


@pytest.mark.parametrize(
    ("found", "files"),
    [
        ([results_with(CURVE)], {"error.png", "spectrum.png", "curve.png"}),
        ([results_with([])], {"error.png", "spectrum.png"}),
        ([], {"error.png", "spectrum.png"}),
    ],
)
def test_picture_charts_after_test_are_written(found, files, clock, system, trainer_with, tmp_path: Path):
    charts = PictureCharts()
    charts.on_test_end(trainer_with(*found, charts), system)
    assert {path.name for path in tmp_path.iterdir()} == files
    for name in files:
        picture = imageio.imread(tmp_path / name)
        assert min(picture.shape[:2]) > 300 and picture.std() > 1


# final.png, and what TensorBoard gets


@pytest.mark.parametrize(
    ("height", "width", "most", "size"),
    [(40, 60, 60, (40, 60)), (40, 60, 100, (40, 60)), (40, 60, 30, (20, 30)), (2, 60, 6, (1, 6)), (5, 3, 1, (2, 1))],
)
def test_narrowed_keeps_proportion(height: int, width: int, most: int, size: tuple[int, int]):
    assert narrowed(np.zeros((height, width, 3), np.uint8), most).shape == (*size, 3)


# training.gif


def write_snapshots(folder: Path, levels: list[int], height: int = 20, width: int = 30) -> None:
    """Snapshots of one brightness each, ten steps apart."""
    folder.mkdir()
    for number, level in enumerate(levels):
        imageio.imwrite(folder / f"step_{10 * number:07d}.png", np.full((height, width, 3), level, np.uint8))


def frames_of(path: Path) -> list[tuple[int, int, tuple[int, int]]]:
    """Brightness, milliseconds and size of each frame."""
    frames = []
    with Image.open(path) as gif:
        for number in range(gif.n_frames):
            gif.seek(number)
            frames.append((gif.convert("L").getpixel((1, 1)), gif.info["duration"], gif.size))
    return frames


def test_training_gif_shows_snapshots_in_order(trainer_with, system, tmp_path: Path, monkeypatch):
    levels, glob = [10, 200, 60, 120], Path.glob
    write_snapshots(tmp_path / "snapshots", levels)
    # Folders list their files in any order.
    monkeypatch.setattr(Path, "glob", lambda folder, pattern: sorted(glob(folder, pattern), reverse=True))
    gif = TrainingGif(fps=5)
    gif.on_test_end(trainer_with(gif), system)
    frames = frames_of(tmp_path / "training.gif")
    assert [level for level, _, _ in frames[:4]] == levels and {level for level, _, _ in frames[3:]} == {120}
    assert [duration for _, duration, _ in frames[:3]] == [200] * 3
    assert sum(duration for _, duration, _ in frames[3:]) == 600
    assert {size for _, _, size in frames} == {(30, 20)}
    with Image.open(tmp_path / "training.gif") as made:
        assert made.info["loop"] == 0, "for ever"


@pytest.mark.parametrize("levels", [None, []])
def test_training_gif_without_snapshots_is_not_written(levels, trainer_with, system, tmp_path: Path):
    if levels is not None:
        write_snapshots(tmp_path / "snapshots", levels)
    TrainingGif().on_test_end(trainer_with(), system)
    assert not list(tmp_path.rglob("*.gif"))
