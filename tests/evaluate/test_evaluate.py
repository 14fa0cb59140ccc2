"""nerf_lightning evaluate, on a run of seconds."""

import json
import math
import shutil
import sys
import types
from pathlib import Path

import imageio.v3 as imageio
import pandas as pd
import pytest
import torch

from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import save_npz
from nerf_lightning.evaluate import metrics
from nerf_lightning.evaluate.metrics import TABLE_DECIMALS, format_table, load_lpips, to_json
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU


@pytest.fixture
def run(small_run: Path, tmp_path: Path) -> Path:
    shutil.copytree(small_run, tmp_path / "run")
    return tmp_path / "run"


def evaluated(run: Path, **options: object) -> dict:
    found = evaluate(run, **options)
    assert found == json.loads((run / "evaluation" / "views.json").read_text())
    return found


def test_evaluate_matches_results_of_run(run: Path, capsys: pytest.CaptureFixture[str]):
    found = evaluated(run, device="cpu")
    out = capsys.readouterr().out
    results = json.loads((run / "results.json").read_text())
    assert len(found["views"]) == results["scene"]["views"]["val"] == 2
    assert found["mean"]["psnr"] == pytest.approx(results["psnr"], abs=0.02)  # which is rounded
    assert min(one["psnr"] for one in found["views"]) == pytest.approx(results["psnr_worst_view"], abs=0.02)
    assert found["mean"]["ssim"] == pytest.approx(results["ssim"], abs=1e-3)
    assert found["mean"]["lpips"] is None and "no LPIPS: " in out
    assert out.count("<- worst") == 1 and f"{found['mean']['psnr']:.2f} dB over 2 held-out views" in out
    assert (found["device"], found["machine"]["accelerator"]) == ("cpu", None) and "held-out views on cpu;" in out
    both = imageio.imread(run / "evaluation" / "worst.png")
    evaluated(run, worst=1)
    assert len(imageio.imread(run / "evaluation" / "worst.png")) == pytest.approx(len(both) / 2, rel=0.1)


def test_evaluate_other_photos_uses_them(run: Path, tmp_path: Path):
    save_npz(bricks(size=24, train_views=4, val_views=3), tmp_path / "other.npz")
    found = evaluated(run, photos=tmp_path / "other.npz")
    assert len(found["views"]) == 3 and found["scene"]["resolution"] == [24, 24]


def test_evaluate_image_run_reports_psnr(tmp_path: Path):
    given = ["+experiment=smoke_2d", "dataset.max_side=32", "budget.steps=2", "~logger"]
    train(compose_config([*given, "callbacks.pictures=null"], tmp_path))
    (view,) = evaluated(tmp_path)["views"]
    results = json.loads((tmp_path / "results.json").read_text())
    assert view["psnr"] == pytest.approx(results["psnr"], abs=0.02)


def test_to_json_missing_metric_has_no_mean():
    views = pd.DataFrame([(20.0, math.nan, math.nan, 1.0), (30.0, 0.5, math.nan, 3.0)], columns=list(TABLE_DECIMALS))
    mean = to_json(views, Path("run"), {}, CPU)["mean"]
    assert mean == {"psnr": 25.0, "ssim": None, "lpips": None, "seconds": 2.0}
    assert format_table(views).splitlines()[1].split() == ["0", "20.00", "-", "-", "1.000", "<-", "worst"]


def test_load_lpips_missing_weights_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    image = torch.ones(80, 100, 3)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert math.isnan(load_lpips()(image, image)) and "pip install 'nerf_lightning[lpips]'" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "torchvision", types.ModuleType("torchvision"))
    assert math.isnan(load_lpips()(image, image))
    weights = tmp_path / "checkpoints" / "alexnet-owt-7be5be79.pth"
    assert f"{weights} does not exist" in capsys.readouterr().out
    weights.parent.mkdir()
    weights.touch()
    asked = {}

    def metric(first: torch.Tensor, second: torch.Tensor, net_type: str, normalize: bool) -> torch.Tensor:
        asked.update(shape=first.shape, net=net_type, normalize=normalize)
        return (first - second).abs().mean()

    monkeypatch.setattr(metrics, "learned_perceptual_image_patch_similarity", metric)
    assert load_lpips()(image, torch.zeros(80, 100, 3)) == 1.0
    assert asked == {"shape": (1, 3, 80, 100), "net": "alex", "normalize": True}, "images in [0, 1], channels first"
    assert math.isnan(load_lpips()(image[:50], image[:50]))
