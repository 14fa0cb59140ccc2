"""Everything on a device that is none of the CPU's: training and what belongs to it, pictures, files and every verb."""

import importlib
import json
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from every_model import MODELS, SCENE
from once import once
from pretend import NAME, Module, Pretend, device, like, missing, register  # noqa: F401  (a fixture)

from nerf_lightning.build import build_data, build_system, frame_of
from nerf_lightning.callbacks import Guard
from nerf_lightning.compose import composed
from nerf_lightning.kernels import sums, use_kernels
from nerf_lightning.seeding import step_generator
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.training import quiet, train

SCENES = ("hashgrid", "voxels", "tensorf", "mlp")
ON_IT = ("device=pretend", "+trainer.inference_mode=false", "~logger")
"""It knows no inference mode."""
QUICK = ("model.grown=0.5", "sampler.update_every=4", "sampler.warmup=8")
SAMPLERS = {
    "uniform": ["sampler=uniform", "sampler.samples=16"],
    "stratified": ["sampler=stratified", "sampler.samples=16"],
    "importance": ["sampler=importance", "sampler.samples=8", "sampler.fine=8"],
}


def options(name: str) -> list[str]:
    """A model's, small, growing where it does; with an orbit of two frames."""
    given = [option for option in MODELS[name] if option not in ("callbacks.orbit=null", "model.grown=1")]
    if name not in SCENES:
        return [f"model={name}", *given]
    if name in ("mlp", "hashgrid"):
        return [f"model={name}", *given, *QUICK[1:], "callbacks.orbit.frames=2"]
    return [f"model={name}", *given, *QUICK, "callbacks.orbit.frames=2"]


@pytest.fixture(autouse=True)
def without_lightnings_hints() -> None:
    quiet()


def trained(name: str, folder: Path, *more: str) -> dict:
    """The results of a run on the device."""
    train(composed([*options(name), *ON_IT, "budget.steps=12", *more], folder))
    return json.loads((folder / "results.json").read_text())


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory, own_cache: None) -> Path:
    """A run of planes and lines made on the CPU, to be opened on the device. To be looked at."""

    def make(folder: Path) -> Path:
        train(composed([*options("tensorf"), "budget.steps=60", "~logger", "callbacks.orbit=null"], folder))
        return folder

    return once(tmp_path_factory, "any_device", make)


def test_the_device_keeps_to_itself(device: torch.device):
    there, here = torch.ones(3, device=device), torch.ones(3)
    with pytest.raises(RuntimeError, match="some tensors are on the device, some on the CPU"):
        there + here
    with pytest.raises(TypeError, match="no numpy"):
        there.numpy()
    assert torch.equal((there + torch.tensor(1.0)).cpu(), torch.full((3,), 2.0)), "a single number may come along"


@pytest.mark.parametrize("name", MODELS)
def test_a_run_ends_as_it_should(name: str, device: torch.device, tmp_path: Path):
    found = trained(name, tmp_path)
    assert found["device"] == f"{NAME}:0" and found["machine"]["accelerator"] == NAME and found["steps"] == 12
    assert math.isfinite(found["psnr"]) and not found["recoveries"]
    assert (tmp_path / "snapshots").is_dir() and (tmp_path / "checkpoints" / "last.ckpt").exists()
    assert (tmp_path / ("orbit.gif" if name in SCENES else "training.gif")).exists() or name not in SCENES


@pytest.mark.parametrize("name", ["tensorf", "voxels", "hashgrid2d"])
def test_a_run_goes_on_where_it_stopped(name: str, device: torch.device, tmp_path: Path):
    trained(name, tmp_path)
    cfg = composed([*options(name), *ON_IT, "budget.steps=20"], tmp_path)
    train(cfg, tmp_path / "checkpoints" / "last.ckpt")
    assert json.loads((tmp_path / "results.json").read_text())["steps"] == 20


def system_of(given: list[str], folder: Path) -> tuple[System, object]:
    cfg = composed(given, folder)
    data = build_data(cfg)
    return build_system(cfg, frame_of(data)), data


def stepped(system: System, data: object, steps: int, where: torch.device) -> list[float]:
    """The losses of the first steps of a scene's training, drawn alike on every device."""
    optimizer, losses = system.configure_optimizers(), []
    for step in range(steps):
        for parameter in system.field.grow(step / steps):
            optimizer.state.pop(parameter, None)
        batch = data.draw(step).to(where)
        loss, stats = system.loss(batch, step_generator(0, 1, step, where), step)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        if stats.counted:
            data.adapt(stats.samples)
        losses.append(float(loss.detach()))
    return losses


VARIANTS = {
    **{name: options(name) for name in SCENES},
    **{
        name: [*(one for one in SCENE if not one.startswith("sampler.")), "model=mlp", "model.width=16", *given]
        for name, given in SAMPLERS.items()
    },
    "penalty, one colour behind": [*options("hashgrid"), "renderer.distortion=0.01", "renderer.background=white"],
    "random colours behind": [*options("tensorf"), "renderer.background=random"],
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("kind", ["alpha", "unbounded"])
def test_steps_come_to_what_they_come_to_on_the_cpu(
    variant: str, kind: str, device: torch.device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(Pretend, "doubles", False)  # Apple's chips have none
    monkeypatch.setattr(sums, "WITHOUT_DOUBLE", (NAME,))
    use_kernels("reference")
    found = {}
    for where in (torch.device("cpu"), device):
        torch.manual_seed(0)
        system, data = system_of([*VARIANTS[variant], "dataset.samples=null"], tmp_path)
        assert isinstance(system, NeRF3D) and data.scene.train.images.shape[-1] == 4
        if kind == "unbounded":
            unbind(system)
        found[where.type] = stepped(system.to(where), data, 7, where)
    assert found[NAME] == pytest.approx(found["cpu"], rel=2e-3)
    assert found[NAME][0] == pytest.approx(found["cpu"][0], rel=1e-5)


def unbind(system: NeRF3D) -> None:
    """A scene with a background."""
    from dataclasses import replace

    for part in (system.field, system.sampler):
        part._bounds = replace(part._bounds, unbounded=True)


@pytest.mark.parametrize("precision", ["bf16-mixed", "16-mixed"])
@pytest.mark.parametrize("name", MODELS)
def test_halves_train_every_method(name: str, precision: str, device: torch.device, tmp_path: Path):
    quick = ["callbacks.snapshots=null", "callbacks.heldout=null", "budget.steps=4"]
    system, losses = None, []
    folder = tmp_path
    from nerf_lightning.build import build_trainer

    cfg = composed([*options(name), *ON_IT, *quick, f"trainer.precision={precision}", "callbacks.orbit=null"], folder)
    data = build_data(cfg)
    system = build_system(cfg, frame_of(data), device)
    build_trainer(cfg, folder, device).fit(system, data)
    assert math.isfinite(float(system.stats.mse))
    assert all(bool(weights.isfinite().all()) for weights in system.parameters())
