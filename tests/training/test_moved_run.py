"""Runs whose photos have moved, of every kind of dataset: they go on, and are measured, on those at dataset.path."""

from pathlib import Path

import pytest
import yaml

from nerf_lightning.dataset import save_npz
from nerf_lightning.synthetic.bricks import bricks

SMALL = (
    *("dataset.rays=64", "dataset.samples=null", "budget.steps=2", "callbacks.throughput=null"),
    *("callbacks.orbit=null", "callbacks.snapshots=null", "logger=null", "model.num_levels=2"),
    *("sampler.resolution=16", "hydra.run.dir=run"),
)


@pytest.mark.parametrize(
    "source",
    [
        ["dataset=lego", "dataset.url=http://stranger.example/published.npz", "dataset.folder=."],
        ["dataset=bricks", "dataset.size=16", "dataset.train_views=4", "dataset.val_views=2"],
    ],
    ids=lambda value: value[0],
)
def test_resume_moved_run_trains_and_evaluates(source: list[str], run_cli, tmp_path: Path):
    save_npz(bricks(size=16, train_views=4, val_views=2), tmp_path / "published.npz")
    code, _, err = run_cli(*source, *SMALL)
    assert code == 0, err
    (tmp_path / "run").rename(tmp_path / "moved")
    (tmp_path / "published.npz").rename(tmp_path / "elsewhere.npz")
    code, _, err = run_cli("resume=moved", "dataset.path=elsewhere.npz", "budget.steps=4")
    assert code == 0, err
    config = yaml.safe_load((tmp_path / "moved" / "config.yaml").read_text(encoding="utf-8"))
    dataset = config["dataset"]
    assert dataset["_target_"] == "nerf_lightning.datamodules.build_photo_data"
    assert (dataset["path"], dataset["rays"]) == (str(tmp_path / "elsewhere.npz"), 64)
    assert config["budget"]["steps"] == 4
    (tmp_path / "elsewhere.npz").rename(tmp_path / "last.npz")
    code, out, err = run_cli("evaluate", "moved", "--photos", "last.npz")
    assert code == 0 and "over 2 held-out views" in out, err
