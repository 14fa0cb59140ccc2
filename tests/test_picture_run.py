"""What a picture's run leaves in its folder."""

import json
from pathlib import Path

import imageio.v3 as imageio
from PIL import Image

from nerf_lightning.config.compose import compose_config
from nerf_lightning.training.train import train


def test_picture_run_writes_pictures_and_figures(isolated_cache: None, tmp_path: Path):
    train(compose_config(["+experiment=picture", "dataset.max_side=24", "budget.steps=20", "render.scale=2"], tmp_path))
    assert {path.name for path in tmp_path.iterdir()} >= {
        "baselines.json", "checkpoints", "config.yaml", "curve.png", "enlarged.json", "enlarged.png",
        "enlarged_panel.png", "error.png", "final.png", "results.json", "snapshots", "spectrum.png", "training.gif",
        "truth.png",
    }  # fmt: skip
    snapshots = sorted(path.name for path in (tmp_path / "snapshots").iterdir())
    assert snapshots == [f"step_{step:07d}.png" for step in (1, 2, 5, 10, 20)]
    assert not list(tmp_path.glob("**/.*")), "no temporary file stays behind"
    assert (tmp_path / "checkpoints" / "best.ckpt").samefile(tmp_path / "checkpoints" / "last.ckpt"), "they are equal"
    assert imageio.imread(tmp_path / "final.png").shape == (24, 24, 3)
    assert imageio.imread(tmp_path / "enlarged.png").shape == (48, 48, 3)
    with Image.open(tmp_path / "training.gif") as gif:
        assert len(snapshots) <= gif.n_frames <= len(snapshots) + 2 and gif.width <= 640
    results, baselines, enlarged = (
        json.loads((tmp_path / f"{name}.json").read_text()) for name in ("results", "baselines", "enlarged")
    )
    assert (results["method"], results["steps"], results["scene"]["name"]) == ("hashgrid2d", 20, "sunset")
    assert baselines["bytes"] == results["artifact_bytes"] and baselines["field"] == results["psnr"]
    assert baselines["picture_bytes"] == 24 * 24 * 3 and baselines["bicubic"]["psnr"] is None
    assert enlarged["scale"] == 2 and enlarged["field"] > 5 and enlarged["bicubic"] > enlarged["field"]
    assert len(results["curve"]) > 5 and results["curve"][-1][1:] == [20, results["psnr"]]
