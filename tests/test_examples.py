"""What stands in examples/ runs as it is written: scripts in this process, the notebook in a Jupyter kernel."""

import os
import runpy
import sys
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import nbformat
import pytest
from nbclient import NotebookClient

from nerf_lightning.dataset import save_npz
from nerf_lightning.synthetic.objects import PILE, make_object_scene
from tests.helpers.tag_views import TAG_SIZE

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"


@pytest.fixture
def example(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs a script with arguments in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(name: str, *arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")

    return run


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "pile.npz"
    save_npz(make_object_scene(PILE, size=16, views=8, held_out=2), path)
    return path


def test_example_train_and_render_writes_view_and_field(example: Callable[..., None], scene: Path, tmp_path: Path):
    example("train_and_render.py", str(scene), "0.5")
    assert imageio.imread(tmp_path / "view.png").shape == (16, 32, 3)
    assert (tmp_path / "field.npz").is_file()


@pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")  # Lightning's progress bar, with PyTorch as it is now
@pytest.mark.parametrize(("part", "steps"), [("field", 10), ("loss", 40), ("sampler", 40)])
def test_example_own_part_learns(
    part: str, steps: int, example: Callable[..., None], scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    example(f"own_{part}.py", str(scene), str(steps))
    assert float(capfd.readouterr().out.split(" dB on")[0].split()[-1]) > 12, "it learns: a black picture has less"
    if part == "field":
        assert imageio.imread(tmp_path / "own_field.png").shape == (16, 32, 3)


def test_example_own_photos_writes_orbit_and_field(example: Callable, tag_capture: tuple, tmp_path: Path):
    folder, _ = tag_capture
    given = [str(folder / "calibration"), str(folder / "photos"), "--tag", str(TAG_SIZE)]
    example("own_photos.py", *given, "--seconds", "0.5", "--pixels", "16")
    assert imageio.imread(tmp_path / "orbit.webp").shape == (12, 16, 3)
    assert (tmp_path / "field.npz").is_file()


@pytest.mark.long
def test_example_tour_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    notebook = nbformat.read(EXAMPLES / "tour.ipynb", as_version=4)
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in notebook.cells)
    monkeypatch.setenv("TOUR_SIZE", "16")
    monkeypatch.setenv("TOUR_STEPS", "5")
    monkeypatch.setenv("PYTHONPATH", f"{ROOT}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    pictures = [out for cell in notebook.cells for out in cell.get("outputs", []) if "image/png" in out.get("data", {})]
    assert len(pictures) == 3, "photos, render and truth, curve"
    assert (tmp_path / "field.npz").is_file()
