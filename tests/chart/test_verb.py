"""The chart's command line."""

import csv
from collections.abc import Callable
from pathlib import Path

import pytest
from made_runs import MakeRun

from nerf_lightning.chart.__main__ import main
from nerf_lightning.chart.verb import split_folders

Command = Callable[..., tuple[int, str, str]]


@pytest.fixture
def chart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Command:
    """Runs the verb in this process; returns exit code, output and errors."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["chart", *arguments])
        code = 0
        try:
            main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        return (code, *capfd.readouterr())

    return run


def test_two_folders_and_their_chart(make_run: MakeRun, chart: Command, tmp_path: Path):
    make_run("one/seed=0,width=16")
    make_run("two/b", {"recipe": "b"}, method="net")
    code, out, _ = chart("runs=runs/one,runs/two", "output=chart")
    assert code == 0
    assert "grid, 5 s" in out and "b, 5 s" in out and "Fastest within 0.5 dB" in out
    assert (tmp_path / "chart" / "chart.html").exists()
    code, out, _ = chart("runs=runs/one/seed=0,width=16", "within_db=2", "~references")
    assert code == 0 and "within 2 dB" in out
    assert (tmp_path / "runs/one/seed=0,width=16/chart/chart.png").exists()
    assert chart("runs=[runs/one,runs/two]", "output=again")[0] == 0


def test_a_run_found_twice_counts_once(make_run: MakeRun, chart: Command, tmp_path: Path):
    make_run("one/a")
    assert chart("runs=runs,runs/one,runs/one/a", "output=chart")[0] == 0
    with (tmp_path / "chart" / "chart.csv").open() as file:
        (line,) = csv.DictReader(file)
    assert line["runs"] == "1"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "runs: found nothing"),
        (["runs=nowhere"], "nowhere: found no such folder"),
        (["runs=."], "found no run in it"),
        (["runs=.", "seconds=-1"], "seconds: found -1, expected a number at least 0"),
        (["runs=.", "within_db=much"], "within_db: found 'much'"),
        (["runs=.", "colour=red"], "colour"),
        (["runs=.", "references.nerfacc.methods.nerfacc=[1]"], "references.nerfacc.methods.nerfacc: found [1]"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: str, chart: Command):
    code, _, errors = chart(*arguments)
    assert code == 2
    assert words in errors and errors.count("\n") == 1


def test_folders_with_commas_in_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b,c=1", "b"):
        (tmp_path / name).mkdir()
    assert [str(one) for one in split_folders("a,b,c=1,b,missing")] == ["a", "b,c=1", "b", "missing"]
