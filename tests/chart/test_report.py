"""The chart's files: whole folders of good and bad runs, in and out of the comparison."""

import contextlib
import csv
import io
import itertools
import json
import re
from dataclasses import dataclass
from pathlib import Path

import imageio.v3 as imageio
import pytest
from chart.conftest import run_maker
from made_runs import MakeRun
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.text import Text

from nerf_lightning.chart.comparison import compare
from nerf_lightning.chart.figure import BEYOND, MOST_ROWS, MOST_TROUBLES, chart_figure
from nerf_lightning.chart.notes import troubles
from nerf_lightning.chart.references import Reference
from nerf_lightning.chart.report import as_svg, write_report
from nerf_lightning.chart.table import write_csv
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.runs.index import find_runs

LIMITS = (0.5, 15, 1.0)
PUBLISHED = [
    Reference("theirs", 35.5, 20.0, "a paper", "a cluster", "toy", "800x800"),
    Reference("slower", 36.5, 90_000.0, "a paper", "a cluster", "toy", "800x800"),
]


@dataclass(frozen=True)
class Report:
    folder: Path
    terminal: str
    figure: Figure
    """Drawn again from the same runs."""


def words_of(figure: Figure) -> str:
    """All text in a figure, its parts included."""
    return " ".join(text.get_text() for text in figure.findobj(Text)).replace("\n    ", " ")


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Report:
    """Two methods, three seeds; a collapsed run, a failed one, one of another scene, one whose results are cut off.

    A report of the first runs alone stood in the folder before.
    """
    root = tmp_path_factory.mktemp("report")
    make_run = run_maker(root / "runs")
    made = [
        make_run(f"{method}{seed}", method=method, seed=seed, psnr=quality + seed / 10, train_seconds=seconds)
        for method, quality, seconds in (("grid", 30.0, 5.0), ("net", 31.0, 15.0))
        for seed in range(3)
    ]
    scene = {"name": "ship", "sha256": "cd" * 32, "views": {"train": 9, "val": 2}, "resolution": [8, 6]}
    runs = [
        *made,
        make_run("lost", {"model": {"width": 1}}, psnr=9.8, status="collapsed", diagnosis="no density left"),
        make_run("broken", {"model": {"width": 2}}, psnr=None, train_seconds=None, curve=[], scene=None, status="failed",
                 diagnosis="out of memory"),
        make_run("elsewhere", scene=scene, seed=5),
        make_run("cut", text='{"scene": {"name": "toy"}, "psnr": 3'),
    ]  # fmt: skip
    terminal = io.StringIO()
    with contextlib.redirect_stdout(terminal):
        write_report(made[:3], [], LIMITS, root / "out")
        write_report(runs, PUBLISHED, LIMITS, root / "out")
    figure = chart_figure(compare(runs, PUBLISHED, *LIMITS), troubles(runs))
    pixels_of(figure)  # as the report does before it writes the SVG
    return Report(root / "out", terminal.getvalue(), figure)


def test_all_that_went_wrong_is_named_on_every_output(report: Report):
    words = words_of(report.figure)
    for text in (report.terminal, (report.folder / "chart.csv").read_text(), words):
        assert all(word in text for word in ("lost", "collapsed", "no density left")), text
        assert all(word in text for word in ("broken", "failed", "out of memory"))
        assert "cut" in text and "unreadable" in text
        assert "ship" in text and "cdcdcdcd" in text
    assert "Collapsed, failed or cut short (3)" in words


def test_files(report: Report):
    names = sorted(path.name for path in report.folder.iterdir())
    assert names == ["chart.csv", "chart.html", "chart.png", "chart.svg", "tensorboard"], "nothing temporary stays"
    picture = imageio.imread(report.folder / "chart.png")
    assert picture.shape[1] == 1560 and picture.std() > 10
    assert (report.folder / "chart.svg").read_text() == as_svg(report.figure), "the same runs give the same SVG"
    with (report.folder / "chart.csv").open() as file:
        lines = list(csv.DictReader(file))
    points = ["grid, width 16, 5 s", "net, 5 s", "grid, 5 s", "lost", "broken", "cut"]
    assert [line["point"] for line in lines] == points
    first = [lines[0][key] for key in ("psnr", "psnr_worst_seed", "seeds", "frontier")]
    assert first == ["30.1", "30.0", "3", "training"] and lines[1]["frontier"] == "training rendering"
    assert len(lines[0]["folders"].split(";")) == 3
    assert [line["status"] for line in lines[3:]] == ["collapsed", "failed", "unreadable"]


def test_the_hparams_tab_holds_the_table_of_the_last_report_alone(report: Report):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams import plugin_data_pb2

    sessions = sorted(path for path in (report.folder / "tensorboard").iterdir() if path.is_dir())
    assert len(sessions) == 3
    events = EventAccumulator(str(sessions[0])).Reload()
    assert events.Scalars("chart/psnr")[0].value == pytest.approx(30.1)
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    start = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info
    assert start.hparams["point"].string_value == "grid, width 16, 5 s"
    assert start.hparams["runs"].number_value == 3


def test_the_page_opens_without_a_network_and_knows_each_configuration(report: Report):
    page = (report.folder / "chart.html").read_text()
    fetched = re.findall(r"""(?:src|href)=["']?(?!#)[^"'>\s]+""", page.replace('xlink:href="#', ""))
    assert not fetched
    points = json.loads(re.search(r'id="points">(.*?)</script>', page, re.S)[1])
    assert set(points) == {"0-0", "0-1", "1-0", "published-0-0", "published-0-1"}
    first = points["0-0"]
    assert first["title"] == "grid, width 16, 5 s"
    assert ["model.width", "16"] in first["options"]
    assert dict(first["figures"])["seeds"] == "0: 30.00 dB, 1: 30.10 dB, 2: 30.20 dB"
    for point in points.values():
        assert all(f'id="{mark}"' in page for mark in point["marks"]), "every point has its marker"
    assert ["source", "a paper"] in points["published-0-0"]["figures"]


def test_publications_beyond_the_axis_stand_at_its_end(report: Report):
    left, right, *_ = report.figure.axes
    names = [text.get_text() for text in left.texts]
    assert "theirs" in names and "slower (25.0 h)" in names
    assert left.get_xlim()[1] < 15.0 * BEYOND * 2
    legend = [text.get_text() for text in report.figure.findobj(Legend)[0].get_texts()]
    assert "published, other hardware" in legend
    assert "theirs" not in [text.get_text() for text in right.texts]


def test_nothing_in_a_run_becomes_code_in_the_page(make_run: MakeRun, tmp_path: Path):
    evil = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"
    write_report([make_run("a", {"recipe": evil}, method=evil)], [], LIMITS, tmp_path / "out")
    page = (tmp_path / "out" / "chart.html").read_text()
    assert page.count("<script") == 2 and "<img" not in page


def test_the_figure_says_what_it_leaves_out(make_run: MakeRun):
    runs = [make_run(f"m{n}", machine={"processor": f"p{n}", "cores": 2}) for n in range(MOST_ROWS + 2)]
    bad = [f"run {n}: failed: x" for n in range(MOST_TROUBLES + 3)]
    figure = chart_figure(compare(runs, [], *LIMITS), bad)
    assert len(figure.axes) == 2 * MOST_ROWS
    assert "2 more settings" in words_of(figure) and "and 3 more" in words_of(figure)


def test_without_any_figures_there_is_still_the_box(make_run: MakeRun, tmp_path: Path):
    run = make_run("a", text="{")
    write_report([run], PUBLISHED, LIMITS, tmp_path / "out")
    assert (tmp_path / "out" / "chart.png").stat().st_size > 1000
    with (tmp_path / "out" / "chart.csv").open() as file:
        assert [line["status"] for line in csv.DictReader(file)] == ["unreadable"]


def test_points_without_rendering_times(make_run: MakeRun, tmp_path: Path):
    runs = [make_run(name, {"recipe": name}, render_seconds_per_view=None, artifact_bytes=None) for name in "ab"]
    assert "not measured" in words_of(chart_figure(compare(runs, [], *LIMITS), []))
    write_csv(tmp_path / "chart.csv", compare(runs, [], *LIMITS), [])
    with (tmp_path / "chart.csv").open() as file:
        assert {line["artifact_bytes"] for line in csv.DictReader(file)} == {""}


def test_garbage_of_all_kinds(make_run: MakeRun, tmp_path: Path):
    """No value a results.json can hold breaks the chart."""
    values = [None, "x", -1, 0, 1e308, [], [1], {}, {"a": 1}, True, float("nan"), float("inf"), "\x00<&$^_{"]
    keys = [
        ("psnr",), ("train_seconds",), ("scene", "versions"), ("background", "load"), ("method", "threads"),
        ("seed", "artifact_bytes"), ("machine", "diagnosis"), ("status", "curve"), ("render_seconds_per_view", "steps"),
    ]  # fmt: skip
    for number, (spoiled, value) in enumerate(itertools.product(keys, values)):
        poorer = {
            "psnr": 30 - number / 100,
            "train_seconds": 5.0 + number,
            "render_seconds_per_view": 0.1 + number / 100,
        }
        name = f"{spoiled[0]}{number}"
        make_run(name, {"recipe": name}, **(poorer | dict.fromkeys(spoiled, value)))
    write_report(find_runs(tmp_path), PUBLISHED, LIMITS, tmp_path / "out")
    assert (tmp_path / "out" / "chart.html").exists()
