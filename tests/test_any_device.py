"""Everything on a device that is not the CPU: training and all that belongs to it, pictures, files and every verb."""

import itertools
import json
import math
from pathlib import Path
from statistics import fmean
from typing import Any

import lightning as L
import numpy as np
import pytest
import torch
import yaml

from nerf_lightning.config.build import build_data, build_system, build_trainer, frame_of
from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import save_npz
from nerf_lightning.runs.open import open_scene_run
from nerf_lightning.synthetic.objects import PILE, make_scene
from nerf_lightning.system import System
from nerf_lightning.training.train import train
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.view.painter import Painter, Wish
from tests.helpers.device_runs import ON_IT, SCENES, options
from tests.helpers.fake_device import NAME, Module
from tests.helpers.shared_fixtures import make_once
from tests.helpers.train_models import MODELS


@pytest.fixture(autouse=True)
def silence_lightning_hints() -> None:
    silence_lightning()


def trained(name: str, folder: Path, *more: str) -> dict:
    """The results of a run on the device."""
    train(composed([*options(name), *ON_IT, "budget.steps=12", *more], folder))
    return json.loads((folder / "results.json").read_text())


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory, own_cache: None) -> Path:
    """A TensoRF run made on the CPU, to be opened on the device. To be looked at."""

    def make(folder: Path) -> Path:
        train(composed([*options("tensorf"), "budget.steps=60", "~logger", "callbacks.orbit=null"], folder))
        return folder

    return make_once(tmp_path_factory, "any_device", make)


@pytest.mark.parametrize("name", MODELS)
def test_run_on_device_of_each_model_finishes(name: str, without_doubles: torch.device, tmp_path: Path):
    found = trained(name, tmp_path)
    assert found["device"] == NAME and found["machine"]["accelerator"] == NAME and found["steps"] == 12
    assert math.isfinite(found["psnr"]) and not found["recoveries"]
    assert (tmp_path / "snapshots").is_dir() and (tmp_path / "checkpoints" / "last.ckpt").exists()
    assert (tmp_path / "orbit.gif").exists() == (name in SCENES)
    assert Module.waited > 0, "clocks are read when the device has done its work"


@pytest.mark.long
@pytest.mark.parametrize("name", ["tensorf", "voxels", "hashgrid2d"])
def test_run_on_device_resumes(name: str, device: torch.device, tmp_path: Path):
    trained(name, tmp_path)
    cfg = composed([*options(name), *ON_IT, "budget.steps=20"], tmp_path)
    train(cfg, tmp_path / "checkpoints" / "last.ckpt")
    assert json.loads((tmp_path / "results.json").read_text())["steps"] == 20


@pytest.mark.parametrize(
    ("name", "precision"), list(zip(MODELS, itertools.cycle(["bf16-mixed", "16-mixed"]), strict=False))
)
def test_mixed_precision_on_device_trains_each_model(name: str, precision: str, device: torch.device, tmp_path: Path):
    quick = ["callbacks.snapshots=null", "callbacks.heldout=null", "callbacks.orbit=null", "budget.steps=2"]
    cfg = composed([*options(name), *ON_IT, *quick, f"trainer.precision={precision}"], tmp_path)
    data = build_data(cfg)
    system = build_system(cfg, frame_of(data), device)
    build_trainer(cfg, tmp_path, device).fit(system, data)
    assert math.isfinite(float(system.stats.mse))
    assert all(bool(weights.isfinite().all()) for weights in system.parameters())


class Spoil(L.Callback):
    """Breaks training after some steps, in one of the ways that the guard knows."""

    def __init__(self, how: str, when: int):
        self.how, self.when = how, when

    def on_train_batch_end(self, trainer: L.Trainer, pl_module: System, *rest: Any) -> None:
        if trainer.global_step == self.when:
            with torch.no_grad():
                weights = next(pl_module.parameters())
                weights.fill_(math.nan if self.how == "nan" else 0.0)
                if self.how == "dead":  # a ReLU below zero everywhere
                    pl_module.field.density_head.weight.zero_()
                    pl_module.field.density_head.bias.fill_(-1.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "how", "more", "action"),
    [
        ("tensorf", "nan", ["callbacks.guard.keep_every=5"], "last good weights"),
        ("mlp", "dead", ["model.density=relu"], "softplus"),
        ("mlp", "", ["optimizer.lr=0.5"], "times the learning rate"),
    ],
)
def test_guard_on_device_restarts_training(
    name: str, how: str, more: list[str], action: str, device: torch.device, tmp_path: Path
):
    quick = ["callbacks.snapshots=null", "callbacks.heldout=null", "callbacks.orbit=null"]
    looks = ["callbacks.guard.every=5", "callbacks.guard.patience=5", "budget.steps=40"]
    cfg = composed([*options(name), *ON_IT, *quick, *looks, *more], tmp_path)
    data = build_data(cfg)
    system = build_system(cfg, frame_of(data), device)
    trainer = build_trainer(cfg, tmp_path, device)
    trainer.callbacks.insert(0, Spoil(how, 12 if how else -1))
    trainer.fit(system, data)
    guard = next(one for one in trainer.callbacks if type(one).__name__ == "Guard")
    assert any(action in one.action for one in guard.recoveries), guard.recoveries
    assert all(bool(weights.isfinite().all()) for weights in system.parameters())


def test_evaluate_on_device_finds_quality_of_training(device: torch.device, run: Path, tmp_path: Path):
    from nerf_lightning.cli.evaluate import evaluate

    judged = evaluate(run, output=tmp_path / "evaluation", worst=1, device=NAME)
    expected = json.loads((run / "results.json").read_text())["psnr"]
    assert judged["device"].startswith(NAME)
    assert fmean(view["psnr"] for view in judged["views"]) == pytest.approx(expected, abs=0.01)


def test_render_on_device_writes_videos_and_images(device: torch.device, run: Path, tmp_path: Path):
    from nerf_lightning.cli.render import render

    render(run, frames=2, channels="rgb,depth,opacity", output=tmp_path / "film.webp", device=NAME)
    render(run, path="test", output=tmp_path / "beside", device=NAME)
    render(run, frames=1, background="transparent", output=tmp_path / "frames", device=NAME)
    assert (tmp_path / "film.webp").exists() and len(list((tmp_path / "beside").glob("*.png"))) == 1


def test_export_on_device_writes_each_kind(device: torch.device, run: Path, tmp_path: Path):
    from nerf_lightning.cli import export

    box = (-0.9, -0.9, -0.9, 0.9, 0.9, 0.9)
    written = [
        export.export_compact(run, output=tmp_path / "compact.npz", loss_db=3.0, device=NAME),
        export.export_mesh(run, output=tmp_path / "mesh.glb", resolution=24, box=box, device=NAME),
        export.export_points(run, output=tmp_path / "points.ply", resolution=24, device=NAME),
        export.export_voxels(run, output=tmp_path / "voxels.npz", resolution=24, device=NAME),
    ]
    assert all(file.stat().st_size > 100 for file in written)


def test_viewer_on_device_paints_each_channel(device: torch.device, run: Path):
    found = open_scene_run(run, device)
    eye = found.orbit.c2w[0].numpy()
    for channel in ("rgb", "depth", "opacity"):
        wish = Wish(eye, 0.8, 1.5, channel, (1.0, 0.5, 0.0), 0.1, math.inf, 64)
        picture = Painter(found.system, found.orbit).paint(wish, 24, lambda: True)
        assert picture.shape == (16, 24, 3) and picture.dtype == np.uint8 and picture.std() > 0


@pytest.mark.long
def test_rightsize_on_device_finds_smallest(device: torch.device, tmp_path: Path):
    from nerf_lightning.cli.rightsize import rightsize

    save_npz(make_scene(PILE, size=16, views=8, held_out=2), tmp_path / "scene.npz")
    rungs = [{"density_components": 8, "colour_components": 8, "coarsest": 4, "finest": side} for side in (4, 8)]
    ladder = {"rungs": rungs, "samplers": [{"samples": 32, "resolution": 8}]}
    (tmp_path / "ladder.yaml").write_text(yaml.safe_dump(ladder))
    options = [
        "recipe=tensorf_medium",
        "budget.steps=6",
        *ON_IT[:2],
        "callbacks.orbit=null",
        "callbacks.snapshots=null",
    ]
    where = {"ladder": str(tmp_path / "ladder.yaml"), "output": tmp_path / "found"}
    found = rightsize(str(tmp_path / "scene.npz"), *options, psnr=8.0, **where)
    assert found["device"].startswith(NAME) and found["reached"]
