"""The chart's files: whole folders of good and bad runs, in and out of the comparison."""

import csv
import itertools
import json
import re
from pathlib import Path

import imageio.v3 as imageio
import pytest
from made_runs import MakeRun
from matplotlib.legend import Legend
from matplotlib.text import Text

from nerf_lightning.chart.comparison import compare
from nerf_lightning.chart.figure import BEYOND, MOST_ROWS, MOST_TROUBLES, chart_figure
from nerf_lightning.chart.notes import troubles
from nerf_lightning.chart.references import Reference
from nerf_lightning.chart.report import as_svg, write_report
from nerf_lightning.runs.index import Run, find_runs

LIMITS = (0.5, 15, 1.0)
PUBLISHED = [
    Reference("theirs", 35.5, 20.0, "a paper", "a cluster", "toy", "800x800"),
    Reference("slower", 36.5, 90_000.0, "a paper", "a cluster", "toy", "800x800"),
]


@pytest.fixture
def runs(make_run: MakeRun) -> list[Run]:
    """Two methods, three seeds; a collapsed run, a failed one, one of another scene, one whose results are cut off."""
    made = [
        make_run(f"{method}{seed}", method=method, seed=seed, psnr=quality + seed / 10, train_seconds=seconds)
        for method, quality, seconds in (("grid", 30.0, 5.0), ("net", 31.0, 15.0))
        for seed in range(3)
    ]
    scene = {"name": "ship", "sha256": "cd" * 32, "views": {"train": 9, "val": 2}, "resolution": [8, 6]}
    return [
        *made,
        make_run("lost", {"model": {"width": 1}}, psnr=9.8, status="collapsed", diagnosis="no density left"),
        make_run("broken", {"model": {"width": 2}}, psnr=None, train_seconds=None, curve=[], scene=None, status="failed",
                 diagnosis="out of memory"),
        make_run("elsewhere", scene=scene, seed=5),
        make_run("cut", text='{"scene": {"name": "toy"}, "psnr": 3'),
    ]  # fmt: skip


def words_of(figure) -> str:
    """All text in a figure, its parts included."""
    return " ".join(text.get_text() for text in figure.findobj(Text)).replace("\n    ", " ")


def test_all_that_went_wrong_is_named_on_every_output(runs: list[Run], tmp_path: Path, capsys):
    write_report(runs, PUBLISHED, LIMITS, tmp_path / "out")
    terminal = capsys.readouterr().out
    table = (tmp_path / "out" / "chart.csv").read_text()
    svg = words_of(chart_figure(compare(runs, PUBLISHED, *LIMITS), troubles(runs)))
    for text in (terminal, table, svg):
        assert all(word in text for word in ("lost", "collapsed", "no density left")), text
        assert all(word in text for word in ("broken", "failed", "out of memory"))
        assert "cut" in text and "unreadable" in text
        assert "ship" in text and "cdcdcdcd" in text
    assert "Collapsed, failed or cut short (3)" in svg


def test_files(runs: list[Run], tmp_path: Path):
    write_report(runs, PUBLISHED, LIMITS, tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["chart.csv", "chart.html", "chart.png", "chart.svg", "tensorboard"]
    picture = imageio.imread(tmp_path / "out" / "chart.png")
    assert picture.shape[1] == 1560 and picture.std() > 10
    with (tmp_path / "out" / "chart.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["point"] for line in lines] == [
        "grid, width 16, 5 s",
        "net, 5 s",
        "grid, 5 s",
        "lost",
        "broken",
        "cut",
    ]
    first = lines[0]
    assert (first["psnr"], first["psnr_worst_seed"], first["seeds"], first["frontier"]) == (
        "30.1",
        "30.0",
        "3",
        "training",
    )
    assert lines[1]["frontier"] == "training rendering"
    assert len(first["folders"].split(";")) == 3
    assert [line["status"] for line in lines[3:]] == ["collapsed", "failed", "unreadable"]


def test_a_second_chart_takes_the_place_of_the_first(runs: list[Run], tmp_path: Path):
    for chosen in (runs, runs[:3]):
        write_report(chosen, [], LIMITS, tmp_path / "out")
    assert sum(path.is_dir() for path in (tmp_path / "out" / "tensorboard").iterdir()) == 1
    assert not list((tmp_path / "out").glob(".*")), "no temporary file stays behind"


def test_the_hparams_tab_holds_the_table(runs: list[Run], tmp_path: Path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
    from tensorboard.plugins.hparams import plugin_data_pb2

    write_report(runs, [], LIMITS, tmp_path / "out")
    sessions = sorted(path for path in (tmp_path / "out" / "tensorboard").iterdir() if path.is_dir())
    assert len(sessions) == 3
    events = EventAccumulator(str(sessions[0])).Reload()
    assert events.Scalars("chart/psnr")[0].value == pytest.approx(30.1)
    content = events.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    start = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info
    assert start.hparams["point"].string_value == "grid, width 16, 5 s"
    assert start.hparams["runs"].number_value == 3


def test_the_page_opens_without_a_network_and_knows_each_configuration(runs: list[Run], tmp_path: Path):
    write_report(runs, PUBLISHED, LIMITS, tmp_path / "out")
    page = (tmp_path / "out" / "chart.html").read_text()
    assert not re.findall(r"""(?:src|href)=["']?(?!#)[^"'>\s]+""", page.replace('xlink:href="#', "")), (
        "nothing is fetched"
    )
    points = json.loads(re.search(r'id="points">(.*?)</script>', page, re.S)[1])
    assert set(points) == {"0-0", "0-1", "1-0", "published-0-0", "published-0-1"}
    first = points["0-0"]
    assert first["title"] == "grid, width 16, 5 s"
    assert ["model.width", "16"] in first["options"]
    assert dict(first["figures"])["seeds"] == "0: 30.00 dB, 1: 30.10 dB, 2: 30.20 dB"
    for point in points.values():
        assert all(f'id="{mark}"' in page for mark in point["marks"]), "every point has its marker"
    assert ["source", "a paper"] in points["published-0-0"]["figures"]


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


def test_publications_beyond_the_axis_stand_at_its_end(runs: list[Run]):
    figure = chart_figure(compare(runs, PUBLISHED, *LIMITS), [])
    left = figure.axes[0]
    names = [text.get_text() for text in left.texts]
    assert "theirs" in names and "slower (25.0 h)" in names
    assert left.get_xlim()[1] < 15.0 * BEYOND * 2
    assert "published, other hardware" in [text.get_text() for text in figure.findobj(Legend)[0].get_texts()]
    assert "theirs" not in [text.get_text() for text in figure.axes[1].texts]


def test_without_any_figures_there_is_still_the_box(make_run: MakeRun, tmp_path: Path):
    run = make_run("a", text="{")
    write_report([run], PUBLISHED, LIMITS, tmp_path / "out")
    assert (tmp_path / "out" / "chart.png").stat().st_size > 1000
    with (tmp_path / "out" / "chart.csv").open() as file:
        assert [line["status"] for line in csv.DictReader(file)] == ["unreadable"]


def test_points_without_rendering_times(make_run: MakeRun, tmp_path: Path):
    runs = [make_run(name, {"recipe": name}, render_seconds_per_view=None, artifact_bytes=None) for name in "ab"]
    write_report(runs, [], LIMITS, tmp_path / "out")
    figure = chart_figure(compare(runs, [], *LIMITS), [])
    assert "not measured" in words_of(figure)


def test_the_same_runs_give_the_same_svg(runs: list[Run]):
    first, second = (as_svg(chart_figure(compare(runs, PUBLISHED, *LIMITS), [])) for _ in range(2))
    assert first == second


def test_garbage_of_all_kinds(make_run: MakeRun, tmp_path: Path):
    """No value a results.json can hold breaks the chart."""
    values = [None, "x", -1, 0, 1e308, [], [1], {}, {"a": 1}, True, float("nan"), float("inf"), "\x00<&$^_{"]
    keys = ("scene", "background", "method", "seed", "machine", "load", "versions", "threads", "artifact_bytes",
            "train_seconds", "psnr", "render_seconds_per_view", "curve", "status", "diagnosis", "steps")  # fmt: skip
    for number, (key, value) in enumerate(itertools.product(keys, values)):
        poorer = {
            "psnr": 30 - number / 100,
            "train_seconds": 5.0 + number,
            "render_seconds_per_view": 0.1 + number / 100,
        }
        make_run(f"{key}{number}", {"recipe": f"{key}{number}"}, **(poorer | {key: value}))
    write_report(find_runs(tmp_path), PUBLISHED, LIMITS, tmp_path / "out")
    assert (tmp_path / "out" / "chart.html").exists()
