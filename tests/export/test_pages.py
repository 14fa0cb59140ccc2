"""Runs as web pages by the command line."""

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from made_runs import results

from nerf_lightning.config.compose import composed
from nerf_lightning.errors import InputError
from nerf_lightning.export.__main__ import task
from nerf_lightning.training.train import train


def told(page: Path) -> dict[str, Any]:
    """What the page knows besides its field."""
    found = re.search(r'<script type="application/json" id="about">(.*?)</script>', page.read_text("utf-8"), re.S)
    assert found
    return json.loads(found[1])


def export(folder: Path, *options: str) -> None:
    task(composed([f"run={folder}", "loss=3", "device=cpu", *options], folder.parent, "export"))


@pytest.fixture(scope="module")
def planes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a finished run of a field that a page draws as it is."""
    folder = tmp_path_factory.mktemp("planes")
    size = ["dataset.size=16", "dataset.train_views=8", "dataset.val_views=1", "dataset.rays=64"]
    train(
        composed(["recipe=tensorf_small", *size, "budget.steps=10", "callbacks.orbit.frames=4"], folder), folder=folder
    )
    return folder


@pytest.fixture
def sweep(planes: Path, tmp_path: Path) -> Path:
    """A folder with a run, a copy of it, and one that never finished."""
    for name in ("a=1,b=2", "second"):
        shutil.copytree(planes, tmp_path / "sweep" / name)
    broken = tmp_path / "sweep" / "broken"
    broken.mkdir()
    (broken / "config.yaml").write_text((planes / "config.yaml").read_text())
    (broken / "results.json").write_text(json.dumps(results(status="interrupted")))
    return tmp_path / "sweep"


def test_a_run_and_its_compact_file_become_pages(planes: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    run = shutil.copytree(planes, tmp_path / "run")
    export(run, "format=html")
    assert "held-out PSNR" in capfd.readouterr().out
    about = told(run / "field.html")
    facts = dict(about["facts"])
    assert facts["held-out PSNR"].endswith(" dB") and facts["training"].endswith("10 steps")
    assert len(about["photos"]["names"]) > 1
    export(run, "format=compact")
    export(run / "compact.npz", "format=html", f"output={tmp_path}/alone.html")
    assert "without photos" in capfd.readouterr().out
    alone = told(tmp_path / "alone.html")
    assert alone["photos"] is None and alone["orbit"] == about["orbit"]


def test_a_folder_of_runs_becomes_pages(sweep: Path, capfd: pytest.CaptureFixture[str]):
    export(sweep, "format=html")
    out = capfd.readouterr().out
    assert "left out: " in out and "2 fields side by side" in out
    gallery = (sweep / "gallery.html").read_text("utf-8")
    assert re.findall(r'<iframe sandbox="allow-scripts"[^>]* src="([^"]*)"', gallery) == [
        "a%3D1%2Cb%3D2/field.html",
        "second/field.html",
    ]
    before = (sweep / "second/field.html").stat().st_mtime_ns
    export(sweep, "format=html")
    assert (sweep / "second/field.html").stat().st_mtime_ns == before, "a page that is there is kept"


def test_a_folder_without_runs_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match="found no run in it"):
        export(tmp_path, "format=html")
    assert not (tmp_path / "gallery.html").exists()
