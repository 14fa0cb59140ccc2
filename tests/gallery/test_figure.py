"""The figure of a sweep: every run is on it, in its place, whatever became of it."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.figure import Figure

from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.errors import InputError
from nerf_lightning.gallery.__main__ import gallery
from nerf_lightning.gallery.figure import MOST, contact_figure, write_contact_figure
from nerf_lightning.runs.index import Run, find_runs


def run_of(folder: Path, config: dict, psnr: float | None, status: str = "finished", diagnosis: str = "") -> Run:
    folder.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(folder / "final.png", np.full((8, 12, 3), 100, np.uint8))
    curve = [] if psnr is None else [[0.1, 1, 10.0], [1.0, 10, psnr]]
    return Run(folder, config, {"psnr": psnr, "curve": curve, "steps": 10}, status, diagnosis)


def captions(figure: Figure) -> list[str]:
    return [axes.get_xlabel() for axes in figure.axes if "dB" in axes.get_xlabel() or "no figure" in axes.get_xlabel()]


def test_two_options_span_a_table(tmp_path: Path):
    runs = [
        run_of(
            tmp_path / f"{width}-{octaves}", {"model": {"frequencies": octaves, "width": width}}, 10 + octaves + width
        )
        for width in (64, 16)
        for octaves in (10, 1, 3)
    ]
    figure = contact_figure(runs, "a study")
    expected = [f"frequencies {o}, width {w}\n{10 + o + w:.2f} dB" for o in (1, 3, 10) for w in (16, 64)]
    assert captions(figure) == expected
    curves, final = figure.axes[-2:]
    assert len(curves.lines) == 6 and len(final.lines) == 2
    assert list(final.lines[0].get_xdata()) == [1, 3, 10] and list(final.lines[0].get_ydata()) == [27, 29, 36]
    assert pixels_of(figure).std() > 1


def test_what_collapsed_or_failed_is_framed_and_told(tmp_path: Path):
    runs = [
        run_of(tmp_path / "a", {"optimizer": {"lr": 0.001}}, 30.0),
        run_of(tmp_path / "b", {"optimizer": {"lr": 0.1}}, 6.0, "collapsed", "every place gets the same colour"),
        run_of(tmp_path / "c", {"optimizer": {"lr": 1.0}}, None, "failed", "ValueError: no"),
    ]
    (tmp_path / "c" / "final.png").write_bytes(b"not a picture")
    figure = contact_figure(runs, "rates")
    assert captions(figure) == ["lr 0.001\n30.00 dB", "lr 0.1\n6.00 dB, collapsed", "lr 1\nno figure, failed"]
    notes = " ".join(text.get_text() for part in figure.subfigs for text in part.texts)
    assert "?" not in notes, "lines end as lines"
    assert "lr 0.1: collapsed: every place gets the same colour" in notes and "ValueError: no" in notes
    final = figure.axes[-1]
    assert final.get_xscale() == "log"
    assert "collapsed" in [text.get_text() for text in final.get_legend().get_texts()]
    pixels_of(figure)


def test_kinds_of_model_stand_side_by_side(tmp_path: Path):
    runs = [
        run_of(tmp_path / name, {"method": name, "model": {"_target_": name}}, 20.0) for name in ("siren", "fourier")
    ]
    figure = contact_figure(runs, "models")
    assert captions(figure) == ["method fourier\n20.00 dB", "method siren\n20.00 dB"]
    assert [tick.get_text() for tick in figure.axes[-1].get_xticklabels()] == ["fourier", "siren"]


@pytest.mark.parametrize("count", [1, 7, MOST + 5])
def test_any_number_of_runs(count: int, tmp_path: Path):
    runs = [run_of(tmp_path / str(i), {"seed": i}, 20.0 + i) for i in range(count)]
    figure = contact_figure(runs, "seeds")
    assert len(captions(figure)) == min(count, MOST)
    assert f"{20 + count - 1:.2f} dB" in captions(figure)[-1], "the best is among them"
    assert ("best" in figure.get_suptitle()) == (count > MOST)


def test_names_that_are_no_mathematics_are_drawn_as_they_are(tmp_path: Path):
    runs = [run_of(tmp_path / "a", {"dataset": {"path": f"$x_{i}^$ 漢"}}, None, "failed", "$broken") for i in (0, 1)]
    pixels_of(contact_figure(runs, "$also_here"))


def test_the_gallery_draws_what_lies_in_a_folder(tmp_path: Path):
    endless = f'{{"scene": {{"name": "{"a" * 10**5}"}}}}'
    for name, text in {"a": "{}", "b": '{"status": "finished", "psnr": 3', "c": endless}.items():
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "results.json").write_text(text)
    found = find_runs(tmp_path / "runs")
    assert [run.status for run in found] == 3 * ["unreadable"]
    assert write_contact_figure(tmp_path / "runs", found) == tmp_path / "runs" / "gallery.png"
    assert imageio.imread(write_contact_figure(tmp_path / "runs", found, tmp_path / "mine.png")).std() > 1


def test_the_figure_is_a_png(tmp_path: Path):
    with pytest.raises(InputError, match=r"output: found .*, expected a file that ends in \.png"):
        gallery(str(tmp_path), str(tmp_path / "figure.npz"))
