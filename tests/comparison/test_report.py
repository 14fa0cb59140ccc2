"""The files of a comparison of good and bad runs."""

import csv
import re
from pathlib import Path

import imageio.v3 as imageio
import pytest

from nerf_lightning.cli.compare import compare
from nerf_lightning.comparison.charts import draw_cost
from nerf_lightning.comparison.points import PUBLISHED_FILE, compute_points, read_references
from nerf_lightning.comparison.report import collect_images
from nerf_lightning.errors import InputError
from tests.comparison.conftest import run_maker
from tests.helpers.run_results import MakeRun

ENTRY = "  source: a paper\n  hardware: a cluster\n  conditions: 800x800\n"
METHODS = "  scenes: {Toy: {theirs: [35.5, 120], slower: [36, 90000.0], later: [36, 3000]}}\n"
EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two methods of three seeds; a collapsed run, a failed one, one of another scene, one whose results are cut off."""
    root = tmp_path_factory.mktemp("report")
    make_run = run_maker(root / "runs")
    for method, quality, seconds in (("grid", 30.0, 5.0), (EVIL, 31.0, 15.0)):
        for seed in range(3):
            make_run(f"{method[:4]}{seed}", method=method, seed=seed, psnr=quality + seed / 10, train_seconds=seconds)
    (root / "runs" / "grid1" / "field.html").write_text("a page")
    lost = {"status": "collapsed", "diagnosis": "no density left"}
    make_run("lost", {"model": {"width": 1}}, psnr=9.8, **lost)
    make_run("broken", {"model": {"width": 2}}, psnr=None, status="failed", diagnosis="out of memory")
    make_run("ship", scene={"name": "ship", "views": {"train": 9, "val": 2}, "resolution": [8, 6]}, seed=5)
    make_run("cut", text='{"scene": {"name": "toy"}, "psnr": 3')
    (root / "mine.yaml").write_text(f"mine:\n{ENTRY}{METHODS}")
    compare(root / "runs", root / "runs" / "ship", references=str(root / "mine.yaml"), output=root / "out")
    return root / "out"


def test_compare_writes_page_figure_and_table(folder: Path):
    assert sorted(path.name for path in folder.iterdir()) == ["compare.csv", "compare.html", "compare.png"]
    figure = imageio.imread(folder / "compare.png")
    assert figure.shape[1] == 1720 and figure.std() > 10
    with (folder / "compare.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["psnr"] for line in lines] == ["31.1", "30.1", "30.0", "", "", ""]
    assert [line["status"] for line in lines[3:]] == ["failed", "unreadable", "collapsed"]
    assert (lines[1]["psnr_min"], lines[1]["runs"], lines[1]["frontier"]) == ("30.0", "3.0", "train_seconds")
    assert len(lines[1]["folders"].split(";")) == 3 and lines[2]["scene"] == "ship"


def test_compare_page_is_self_contained_and_escapes_names(folder: Path):
    page = (folder / "compare.html").read_text("utf-8")
    assert "<script" not in page and "<img src=x" not in page and "alert(1)" in page
    assert re.findall(r'(?:src|href)="(?!data:)([^"]*)"', page) == ["../runs/grid1/field.html"]
    for words in ("lost: collapsed: no density left", "broken: failed: out of memory", "cut: unreadable", "ship, 8x6"):
        assert words in page
    assert "Published, other hardware: 800x800; a cluster; a paper." in page
    assert "<dt>model.width</dt><dd>16</dd>" in page


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"runs": [Path("nowhere")]}, "no such folder"),
        ({"runs": [Path()]}, "no run"),
        ({"runs": [Path()], "references": "missing.yaml"}, "missing.yaml"),
    ],
)
def test_compare_bad_input_raises(arguments: dict, words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=words):
        compare(*arguments.pop("runs"), **arguments)
    assert not list(tmp_path.iterdir())


def test_draw_cost_labels_points_and_off_axis_publications(make_run: MakeRun, tmp_path: Path):
    (tmp_path / "mine.yaml").write_text(f"mine:\n{ENTRY}{METHODS}")
    runs = [make_run(name, {"recipe": name}, train_seconds=10.0 + n, psnr=30.0 + n) for n, name in enumerate("abc")]
    points = compute_points(runs)[0][1].assign(style=[("black", "o")] * 3)
    (axes,) = draw_cost(points, "train_seconds", read_references(tmp_path / "mine.yaml")).axes
    names = ["a", "b", "c", "later (50 min)", "slower (25.0 h)", "theirs"]
    assert sorted(text.get_text() for text in axes.texts) == names
    assert [text.get_text() for text in axes.get_legend().get_texts()] == [
        "published, other hardware",
        "Pareto frontier",
    ]
    assert 300 < axes.get_xlim()[1] < 1000
    (axes,) = draw_cost(points, "bytes", read_references(PUBLISHED_FILE).head(0)).axes
    assert axes.get_legend() is None, "one size, so one point on the frontier and no key"


def test_collect_images_truth_comes_first(make_run: MakeRun):
    found = collect_images(compute_points([make_run("a"), make_run("b", {"recipe": "b"})])[0][1])
    assert [caption.partition("\n")[0] for caption, _ in found] == ["truth", "grid", "b"]
    assert [int(image[-1, -1, 0]) for _, image in found] == [200, 100, 100]
    assert {image.shape for _, image in found} == {(320, 480, 3)}


@pytest.mark.parametrize(
    "text",
    [
        "one: 35 dB",
        f"one:\n{METHODS}",
        f"one:\n{ENTRY}  scenes: {{Toy: {{a: [35, 0]}}}}",
        f"one:\n{ENTRY}  scenes: {{Toy: {{a: 35}}}}",
    ],
)
def test_read_references_damaged_file_is_one_error(text: str, tmp_path: Path):
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(InputError, match="mine.yaml.*publications"):
        read_references(tmp_path / "mine.yaml")


def test_read_references_published_file_is_valid():
    found = read_references(PUBLISHED_FILE)
    assert len(found) == 8 * 11 + 2 and found["scene"].nunique() == 8 and found["psnr"].between(13, 40).all()
    (ngp_pl,) = found[(found["name"] == "ngp_pl") & (found["scene"] == "lego")].itertuples()
    assert (ngp_pl.psnr, ngp_pl.seconds) == (35.76, 305)
