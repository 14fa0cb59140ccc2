"""A run is found by its folder, its compact file, a folder of runs, or as the newest of all."""

import os
from pathlib import Path

import pytest

from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import find_run, link_latest
from nerf_lightning.runs.run_lock import RUN_MARKER


def make_run(folder: Path, seconds: float) -> Path:
    """A run that was last written at a time."""
    (folder / "checkpoints").mkdir(parents=True)
    for name in ("config.yaml", "results.json", "checkpoints/last.ckpt", RUN_MARKER):
        (folder / name).touch()
        os.utime(folder / name, (seconds, seconds))
    return folder


@pytest.fixture
def outputs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two runs of one name, a newer one of another, and a job that failed before its first checkpoint."""
    monkeypatch.chdir(tmp_path)
    make_run(Path("outputs/lego/1"), 300)
    make_run(Path("outputs/lego/2"), 200)
    make_run(Path("outputs/chair/sweep/seed=0"), 400)
    Path("outputs/chair/sweep/seed=1").mkdir()
    Path("outputs/chair/sweep/seed=1/config.yaml").touch()
    return tmp_path / "outputs"


def test_find_run_returns_newest_run_of_folder(outputs: Path):
    Path("small.npz").touch()
    assert find_run(Path("outputs/lego/2")) == Path("outputs/lego/2")
    assert find_run("small.npz") == Path("small.npz")
    assert find_run(Path("outputs/lego")) == Path("outputs/lego/1")
    assert find_run() == Path("outputs/chair/sweep/seed=0")
    os.utime("outputs/lego/2/checkpoints/last.ckpt", (500, 500))
    assert find_run() == Path("outputs/lego/2")


def test_find_run_missing_run_names_search_path(outputs: Path):
    Path("empty").mkdir()
    for name, found in (("nowhere", "no such file"), ("empty", "a folder without a run")):
        with pytest.raises(InputError, match=f"{name}: {found}.*; give a folder"):
            find_run(name)


def test_link_latest_points_to_newest_run(outputs: Path, monkeypatch: pytest.MonkeyPatch):
    for name in ("2", "1"):
        link_latest(Path("outputs/lego") / name)
        assert os.readlink(outputs / "lego" / "latest") == name
    assert find_run("outputs/lego/latest").resolve() == outputs / "lego" / "1"
    link_latest(Path("outputs/chair/sweep/seed=0"))
    assert not (outputs / "chair" / "sweep" / "latest").exists(), "a job is no run of its own"
