"""Evaluation of a scene's test split."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import RayDataModule, Scene
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.training.train import train

OPTIONS = ["+experiment=smoke_3d", "budget.steps=3", "callbacks.orbit=null", "callbacks.snapshots=null", "~logger"]


@pytest.fixture
def scene() -> Scene:
    small = bricks(size=16, train_views=6, val_views=5)
    return replace(small, val=bricks(size=16, train_views=6, val_views=2).val, test=small.val)


def results(folder: Path) -> dict:
    return json.loads((folder / "results.json").read_text())


def test_evaluate_test_split_reports_separate_metrics(scene: Scene, tmp_path: Path, monkeypatch, capsys):
    train(compose_config(OPTIONS, tmp_path), scene=scene)
    found = results(tmp_path)
    test = found["test"]
    assert (test["views"], test["views_in_split"]) == (5, 5) and found["scene"]["views"] == {
        "train": 6,
        "val": 2,
        "test": 5,
    }
    assert (
        f"{found['psnr']:.2f} dB held out (val), {test['psnr']:.2f} dB on 5 test views, after"
        in capsys.readouterr().out
    )

    monkeypatch.setattr("nerf_lightning.runs.reload.reload_data", lambda *given: RayDataModule(scene))
    for split, expected in (("val", found), ("test", test)):
        judged = evaluate(tmp_path, split=split)
        assert judged["mean"]["psnr"] == pytest.approx(expected["psnr"], abs=0.02)
        assert judged["mean"]["ssim"] == pytest.approx(expected["ssim"], abs=1e-3)
        worst = min(view["psnr"] for view in judged["views"])
        assert worst == pytest.approx(expected["psnr_worst_view"], abs=0.02)


@pytest.mark.parametrize(("split", "words"), [("test", "have no test split"), ("all", "one of val, test")])
def test_evaluate_unknown_split_raises(split: str, words: str, scene: Scene, small_run: Path, tmp_path: Path):
    with pytest.raises(InputError, match=words):
        evaluate(small_run, split=split, output=tmp_path)
