"""The chart's command line."""

import csv
from functools import partial
from pathlib import Path

import pytest
from made_runs import MakeRun

from nerf_lightning.chart.__main__ import main, split_folders


@pytest.fixture
def chart(verb):
    return partial(verb, main)


def test_folders_and_their_chart(make_run: MakeRun, chart, tmp_path: Path):
    make_run("one/seed=0,width=16")
    make_run("two/b", {"recipe": "b"}, method="net")
    code, out, _ = chart("runs=runs/one,runs/two,runs", "output=chart")
    assert code == 0
    assert "grid, 5 s" in out and "b, 5 s" in out and "Fastest within 0.5 dB" in out
    with (tmp_path / "chart" / "chart.csv").open() as file:
        assert [line["runs"] for line in csv.DictReader(file)] == ["1", "1"], "a run found twice counts once"
    code, out, _ = chart("runs=['runs/one/seed=0,width=16',runs/two]", "within_db=2", "~references")
    assert code == 0 and "within 2 dB" in out
    assert (tmp_path / "runs/one/seed=0,width=16/chart/chart.html").exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "runs: found nothing"),
        (["runs=[]"], "runs: found nothing, expected folders with runs"),
        (["runs=nowhere"], "nowhere: found no such folder"),
        (["runs=."], "found no run in it"),
        (["runs=.", "seconds=-1"], "seconds: found -1, expected a number at least 0"),
        (["runs=.", "within_db=much"], "within_db: found 'much'"),
        (["runs=.", "colour=red"], "colour"),
        (["runs=.", "references.nerfacc.methods.nerfacc=[1]"], "references.nerfacc.methods.nerfacc: found [1]"),
    ],
)
def test_bad_input_is_one_line(arguments: list[str], words: str, chart):
    code, _, errors = chart(*arguments)
    assert code == 2
    assert words in errors and errors.count("\n") == 1


def test_folders_with_commas_in_their_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    for name in ("a", "b,c=1", "b"):
        (tmp_path / name).mkdir()
    assert [str(one) for one in split_folders("a,b,c=1,b,missing")] == ["a", "b,c=1", "b", "missing"]
