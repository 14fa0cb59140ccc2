"""Every code block of README.md and docs/ runs: each page from top to bottom, with small scenes and budgets."""

import logging
import re
import shlex
import shutil
import signal
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest

from nerf_lightning.cli.app import main
from nerf_lightning.export.transforms import write_photos
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.utils.signals import SignalInterrupt
from tests.helpers.command_line import BARE
from tests.helpers.tag_views import TAG_SIZE

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
PAGES = [README, *sorted(page for page in (ROOT / "docs").glob("*.md") if page.name != "index.md")]

SCENE = (
    "dataset.download=false dataset.resize=16 dataset.rays=64 callbacks.orbit.frames=2 budget.seconds=null budget.steps=2"
    " sampler.samples=32 sampler.resolution=16"
)
VIEWS = "dataset.size=16 dataset.train_views=4 dataset.val_views=1"
PLAIN = " ".join(BARE)
PICTURE = "dataset.max_side=16 dataset.pixels=64 budget.seconds=null budget.steps=2"
SMALLER: list[tuple[str, str]] = [
    ("experiment=pareto", f"{SCENE} recipe=tensorf_small seed=0"),
    ("experiment=study_grid", f"{PICTURE} {PLAIN} model.num_frequencies=1 model.width=16"),
    ("experiment=study_frequencies", f"{PICTURE} {PLAIN} model.num_frequencies=2"),
    ("experiment=study_lr", f"{PICTURE} {PLAIN} optimizer.lr=1e-1"),
    ("render.scale=2", "dataset.max_side=16 dataset.pixels=64 budget.steps=2"),
    ("experiment=capture", "dataset.rays=64 callbacks.orbit.frames=2 budget.steps=2 budget.seconds=null"),
    ("rightsize", f"{SCENE} --ladder ladder.yaml"),
    ("best.yaml", "dataset.rays=64 callbacks.orbit.frames=2 budget.seconds=null budget.steps=2"),
    ("experiment=lego", SCENE),
    ("-m +experiment=picture", f"{PICTURE} {PLAIN}"),
    ("experiment=picture", PICTURE),
    ("model=ball", f"{VIEWS} budget.steps=2 callbacks.orbit.frames=2 sampler.resolution=16"),
    ("capture --calibration", f"--tag-size {TAG_SIZE} --resize 60"),
    ("nerf_lightning render", "--frames 2"),
    ("export compact", "--max-psnr-drop 100"),
    ("export html", "--max-psnr-drop 100 --cells 16"),
    ("export voxels", "--resolution 24"),
    ("export transforms", ""),
    ("nerf_lightning export", "--threshold 1e-3 --resolution 24"),
]
"""What is added to a command that holds some words; the first that fits counts."""
COMPOSED = (
    *("launcher=joblib", "trainer=ddp", "tune_picture", "nerf_lightning stability", "--psnr 28"),
    *("budget.seconds=180", "device=cpu ", "lego_hashgrid", "voxels_small", "dataset=photos", "-m +experiment=lego"),
)
"""Commands that start processes of their own, are tested as such elsewhere, or take long: only their words are checked."""
PYTHON = [
    ("seconds=15", f"steps=2, options={SCENE.replace('dataset.download=false ', '').split()}"),
    ("output=", "max_psnr_drop=100, output="),
]
"""Replacements that make the Python block of the README small."""


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands(page: Path) -> list[str]:
    lines = [line for block in blocks(page, "bash") for line in block.splitlines()]
    return [line for line in lines if line.strip() and not line.startswith("pip install -e ")]


def place(tmp_path: Path) -> Path:
    """A folder whose name needs quoting in shells, Hydra and URLs."""
    folder = tmp_path / "it's a test, (1) = ünï"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture
def shell(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], int]]:
    """Runs a command line in this process, in an empty folder; returns its exit code."""
    from nerf_lightning.view.field_page import FieldPage
    from nerf_lightning.view.scene_page import ScenePage

    def leave(*_: Any) -> None:
        raise SignalInterrupt(signal.SIGINT)

    monkeypatch.setattr(FieldPage, "run", leave)
    monkeypatch.setattr(ScenePage, "run", leave)
    monkeypatch.chdir(place(tmp_path))
    monkeypatch.delenv("NERF_LIGHTNING_TRACEBACK", raising=False)

    def run(line: str) -> int:
        words = shlex.split(line, comments=True)
        while "=" in words[0]:
            key, value = words.pop(0).split("=", 1)
            monkeypatch.setenv(key, value)
            if key == "PYTHONPATH":
                monkeypatch.syspath_prepend(str(place(tmp_path) / value))
        assert words.pop(0) == "nerf_lightning", line
        try:
            main(words)
        except SystemExit as stop:
            return int(stop.code or 0)
        finally:
            logging.getLogger().handlers.clear()
        return 0

    yield run
    sys.modules.pop("ball", None)


def smaller(line: str) -> str:
    if any(words in line for words in COMPOSED):
        one = re.sub(r"(-m (?=\+))|(\w+=\d(,\d)+)", "", line.partition(" #")[0])  # of a sweep's jobs
        return f"{one} {'--cfg job' if ' train ' in one else '--help'}"
    more = next((more for words, more in SMALLER if words in line), "")
    short = line.partition(" #")[0]
    for option in re.findall(r"--[\w-]+", more):  # given once
        short = re.sub(rf"{option} \S+", "", short)
    return f"{short} {more}"


@pytest.mark.parametrize(
    "page", [page for page in PAGES if "```bash" in page.read_text(encoding="utf-8")], ids=lambda page: page.stem
)
def test_docs_page_commands_succeed(page: Path, shell: Callable[[str], int], tmp_path: Path, capfd, request):
    tmp_path = place(tmp_path)
    (tmp_path / "ladder.yaml").write_text(
        "rungs: [{max_resolution: 8, base_resolution: 8}, {max_resolution: 12, base_resolution: 8}]\n"
    )
    files = [block for language in ("python", "yaml") for block in blocks(page, language) if block.startswith("# ")]
    for block in files:
        file = tmp_path / block.splitlines()[0].removeprefix("# ")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(block)
    if "--calibration sheet_photos" in page.read_text(encoding="utf-8"):
        folder, _ = request.getfixturevalue("tag_capture")
        shutil.copytree(folder / "calibration", tmp_path / "sheet_photos")
        shutil.copytree(folder / "photos", tmp_path / "object_photos")
    if "my_photos" in page.read_text(encoding="utf-8"):
        (tmp_path / "my_photos").mkdir()
        write_photos(bricks(24, 12, 2, 4), tmp_path / "my_photos")
    imageio.imwrite(tmp_path / "cat.jpg", np.tile(np.arange(0, 240, 10, np.uint8)[:, None, None], (1, 20, 3)))
    assert commands(page)
    for line in commands(page):
        code = shell(smaller(line))
        assert code == 0, f"{line}\n{capfd.readouterr().err}"
    for block in blocks(page, "python"):
        if block not in files:
            for words, small in PYTHON:
                block = block.replace(words, small)
            exec(compile(block, page, "exec"), {})


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_docs_links_targets_and_extras_exist(page: Path):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / target).exists(), target
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {extra for group in re.findall(r"\.\[([\w,]+)\]", text) for extra in group.split(",")}
    assert extras <= {*project["optional-dependencies"]}
    assert page == README or f"docs/{page.name}" in README.read_text(encoding="utf-8")
