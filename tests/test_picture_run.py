"""What a picture's run leaves in its folder."""

import json
from pathlib import Path

import imageio.v3 as imageio
import pytest
from PIL import Image

from nerf_lightning.config.compose import composed
from nerf_lightning.training.train import train

SMALL = ["+experiment=picture", "dataset.max_side=24", "budget.steps=20", "render.scale=2"]
STEPS = [1, 2, 5, 10, 20]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory, own_cache: None) -> Path:
    folder = tmp_path_factory.mktemp("picture")
    train(composed(SMALL, folder))
    return folder


def read(path: Path) -> dict:
    return json.loads(path.read_text(encoding="utf-8"))


def test_picture_run_writes_pictures_and_figures(run: Path):
    assert {path.name for path in run.iterdir()} >= {
        "baselines.json", "checkpoints", "config.yaml", "curve.png", "enlarged.json", "enlarged.png",
        "enlarged_panel.png", "error.png", "final.png", "results.json", "snapshots", "spectrum.png", "training.gif",
        "truth.png",
    }  # fmt: skip
    assert sorted(path.name for path in (run / "snapshots").iterdir()) == [f"step_{step:07d}.png" for step in STEPS]
    assert not list(run.glob("**/.*")), "no temporary file stays behind"
    assert (run / "checkpoints" / "best.ckpt").samefile(run / "checkpoints" / "last.ckpt"), (
        "one file where they are equal"
    )


def test_picture_run_pictures_have_expected_sizes(run: Path):
    assert imageio.imread(run / "final.png").shape == (24, 24, 3)
    assert imageio.imread(run / "enlarged.png").shape == (48, 48, 3)
    with Image.open(run / "training.gif") as gif:
        assert len(STEPS) <= gif.n_frames <= len(STEPS) + 2 and gif.width <= 640


def test_picture_run_figures_agree(run: Path):
    results, baselines, enlarged = (read(run / f"{name}.json") for name in ("results", "baselines", "enlarged"))
    assert (results["method"], results["steps"], results["scene"]["name"]) == ("hashgrid2d", 20, "sunset")
    assert baselines["bytes"] == results["artifact_bytes"] and baselines["field"] == results["psnr"]
    assert baselines["picture_bytes"] == 24 * 24 * 3 and baselines["bicubic"]["psnr"] is None
    assert enlarged["scale"] == 2 and enlarged["field"] > 5 and enlarged["bicubic"] > enlarged["field"]
    assert len(results["curve"]) > 5 and results["curve"][-1][1:] == [20, results["psnr"]]
