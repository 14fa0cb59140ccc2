"""Devices other than the CPU: training steps, their operations and synchronizations, runs, and tools."""

import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from benchmarks.op_counter import OpCounter
from benchmarks.step_time import Training
from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.cli.export import export_compact, export_mesh, export_points, export_voxels
from nerf_lightning.cli.render import render
from nerf_lightning.config.build import build_data, build_system, get_metadata
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.kernels import gpu, set_kernels
from nerf_lightning.runs.open import open_scene_run
from nerf_lightning.synthetic.rooms import ROOMS, make_room_scene
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.system.growth import compute_next_stage, upsample_field
from nerf_lightning.system.system import sum_losses
from nerf_lightning.training.train import train
from nerf_lightning.utils.libraries import silence_lightning
from nerf_lightning.utils.seeding import Stream, step_generator
from nerf_lightning.view.progressive import ProgressiveRenderer, ViewRequest
from tests.helpers.fake_device import NAME, PretendModule
from tests.helpers.growth import grow
from tests.helpers.train_models import MODELS, SCENE, SMALL_BRICKS

SCENES = ("hashgrid", "voxels", "tensorf", "mlp")
ON_DEVICE = ("device=pretend", "+trainer.inference_mode=false", "~logger")
"""Its tensors do not support inference mode."""
QUICK = ("model.growth_end=0.5", "sampler.update_every=4", "sampler.warmup=8")
SAMPLERS = {
    "uniform": ["sampler=uniform", "sampler.samples=16"],
    "stratified": ["sampler=stratified", "sampler.samples=16"],
    "importance": ["sampler=importance", "sampler.samples=8", "sampler.importance_samples=8"],
    "proposal": ["sampler=proposal", "sampler.samples=8", "sampler.coarse_samples=8", "sampler.fine_samples=8"],
}


def small_options(name: str) -> list[str]:
    """Builds a small system of a model and its data, with an orbit of two frames."""
    given = [option for option in MODELS[name] if option not in ("callbacks.orbit=null", "model.growth_end=1")]
    if name not in SCENES:
        return [f"model={name}", *given]
    if name in ("mlp", "hashgrid"):
        return [f"model={name}", *given, *QUICK[1:], "callbacks.orbit.frames=2"]
    return [f"model={name}", *given, *QUICK, "callbacks.orbit.frames=2"]


def build_system_and_data(given: list[str], folder: Path) -> tuple[System, object]:
    cfg = compose_config(given, folder)
    data = build_data(cfg)
    return build_system(cfg, get_metadata(data)), data


def build_capture(given: list[str], rays: int, folder: Path) -> tuple[System, RayDataModule]:
    """A system as captures have it, and a small room."""
    data = RayDataModule(make_room_scene(ROOMS["small subject"], 0, size=16, views=6, held_out=1), rays, None)
    data.enable_texturelessness(True)
    cfg = compose_config(["+experiment=capture", "dataset.path=room", *given], folder)
    return build_system(cfg, get_metadata(data)), data


def train_steps(system: System, data: object, steps: int, where: torch.device) -> list[float]:
    """The losses of the first steps of a scene's training, drawn alike on every device."""
    optimizer, losses = system.configure_optimizers(), []
    for step in range(steps):
        system.state.set_progress(step / steps)
        if (stage := compute_next_stage(system, step)) is not None:
            upsample_field(system, data, stage, optimizer)
        batch, generator = data.draw(step).to(where), step_generator(0, Stream.STEP, step, where)
        system.sampler.update(step, system.field.density, generator)
        found, stats = system.compute_losses(batch, generator)
        loss = sum_losses(found)
        loss.backward()
        optimizer.step()
        optimizer.zero_grad()
        data.adapt_num_rays(stats.samples)
        losses.append(float(loss.detach()))
    return losses


BARE_SCENE = [option for option in SCENE if not option.startswith("sampler.")]
PENALTY = ["renderer.distortion_loss_weight=0.01", "renderer.background=white"]
VARIANTS = {
    **{name: small_options(name) for name in SCENES},
    **{name: [*BARE_SCENE, "model=mlp", "model.width=16", *given] for name, given in SAMPLERS.items()},
    "penalty, one color behind": [*small_options("hashgrid"), *PENALTY],
    "random colors behind": [*small_options("tensorf"), "renderer.background=random"],
}


@pytest.mark.parametrize(("variant", "unbounded"), list(zip(VARIANTS, itertools.cycle([False, True]), strict=False)))
def test_training_steps_on_device_match_cpu(variant: str, unbounded: bool, device_without_float64, tmp_path: Path):
    set_kernels("reference")
    found = {}
    for where in (torch.device("cpu"), device_without_float64):
        torch.manual_seed(0)
        system, data = build_system_and_data([*VARIANTS[variant], "dataset.samples=null"], tmp_path)
        assert isinstance(system, NeRF3D) and data.scene.train.images.shape[-1] == 4
        for part in (system.field, system.sampler):
            part.bounds = replace(part.bounds, unbounded=unbounded)
        found[where.type] = train_steps(system.to(where), data, 7, where)
    assert found[NAME] == pytest.approx(found["cpu"], rel=2e-3)
    assert found[NAME][0] == pytest.approx(found["cpu"][0], rel=1e-5)


MAX_OPERATIONS = {"tensorf": 271, "hashgrid": 270, "voxels": 273, "mlp": 242}
"""Operations a step between two updates of the sampler: forward, backward, optimizer. Each takes 5 to 10 microseconds."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "hashgrid" else pytest.mark.long) for name in MAX_OPERATIONS]
)
def test_training_step_on_device_needs_few_operations_and_no_wait(name: str, device: torch.device, tmp_path: Path):
    """With shipped settings, at the final field size; reading a result, or its size, makes the host wait."""
    small = SMALL_BRICKS
    system, data = build_system_and_data([f"recipe={name}_medium", *small, "sampler.warmup=0"], tmp_path)
    assert isinstance(system, NeRF3D)
    system, period, counts = system.to(device), system.sampler.update_every, []
    optimizer = system.configure_optimizers()
    for step in range(2 * period):
        grow(system.field, 0.9)
        batch = data.draw(step).to(device)
        with OpCounter() as count:
            generator = step_generator(0, Stream.STEP, step, device)
            system.sampler.update(step, system.field.density, generator)
            losses, stats = system.compute_losses(batch, generator)
            sum_losses(losses).backward()
            optimizer.step()
            optimizer.zero_grad()
        data.adapt_num_rays(stats.samples)
        counts.append(count)
    for count in counts[-period + 3 :]:  # the first ones after an update make what is then kept for the device
        assert count.operations <= MAX_OPERATIONS[name], count.names.most_common()
    assert sum(count.waits for count in counts[-period:]) == 1, "to read the sample counts"


LARGE_PLANES = [
    f"model.{option}" for option in ("base_resolution=302", "max_resolution=302", "stages=1", "width=64", "size=fixed")
]
BYTES = {
    "tensorf_medium": ([*LARGE_PLANES, "sampler.resolution=120"], 12_348, (457e3, 125e3), 1.1e9),
    "hashgrid_medium": (["model.size=fixed"], 8446, (144e3, 53e3), 0.48e9),
}
"""Options, rays, their steps in occupied cells and visible ones, at photos of 800 pixels; bytes that a step moves at most."""


class ZeroMemory(TorchDispatchMode):
    """Zeroes new memory."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        return out.zero_() if "empty" in function._schema.name else out


@pytest.mark.parametrize("recipe", BYTES)
def test_training_step_with_gpu_kernels_moves_few_bytes(recipe: str, device: torch.device, tmp_path: Path, monkeypatch):
    """The kernels' outputs stay zeros: between two reads of the sample counts, sizes follow from rays and capacities."""
    pytest.importorskip("triton", "3.3", reason="the extra `test` installs triton on Linux")
    given, rays, counts, max_bytes = BYTES[recipe]
    small = [*SMALL_BRICKS, "dataset.samples=null"]
    options = [f"recipe={recipe}", *given, *small, f"dataset.rays={rays}", "limits.chunk_samples=524288"]
    system, data = build_system_and_data(options, tmp_path)
    system.to(device).sampler.capacity.per_ray = {False: tuple(count / rays for count in counts)}
    training = Training(data, data.photos.to(device), system, system.configure_optimizers(), 16, 1, next_step=1)
    monkeypatch.setattr(gpu.launch, "run_kernel", lambda *arguments: None)
    set_kernels("triton")
    with ZeroMemory():
        training.step()  # makes what is cached from then on
        with OpCounter() as count:
            training.step()
    assert count.bytes <= max_bytes, count.bytes_by_name.most_common(5)


def test_rays_of_sixteen_steps_are_drawn_together(device: torch.device, tmp_path: Path):
    _, data = build_system_and_data(small_options("hashgrid"), tmp_path)
    views = data.photos.to(device)
    data.draw_batch(views, 0, slice(None))
    with OpCounter() as count:
        batches = [data.draw_batch(views, step, slice(None)) for step in range(16, 32)]
    assert count.operations <= 64 and count.waits == 0, count.names.most_common()
    assert len({tuple(batch.rays.directions[0].tolist()) for batch in batches}) == 16
    data.update_error_map(torch.ones(data.rays).to(device))
    _, resumed = build_system_and_data(small_options("hashgrid"), tmp_path)
    resumed.load_state_dict(data.state_dict())
    pixels = [x.draw_batch(views, 21, slice(1, None, 2)).pixels.cpu() for x in (resumed, resumed)]
    assert torch.equal(pixels[0], batches[5].pixels.cpu()[1::2]) and torch.equal(*pixels)


@pytest.mark.parametrize("name", ["hashgrid2d", "picture_mlp", "fourier", "siren"])
def test_picture_step_on_device_needs_no_wait(name: str, device: torch.device, tmp_path: Path):
    system, data = build_system_and_data(small_options(name), tmp_path)
    optimizer, batch = system.to(device).configure_optimizers(), data.draw(0).to(device)
    for _ in range(2):
        with OpCounter() as count:
            system.training_step(batch, 0).backward()
            optimizer.step()
            optimizer.zero_grad()
    assert count.waits == 0 and count.operations <= 100, count.names.most_common()


def test_step_rays_beyond_capacity_do_not_train(device: torch.device, tmp_path: Path):
    system, data = build_system_and_data(small_options("hashgrid"), tmp_path)
    assert isinstance(system, NeRF3D)
    train_steps(system.to(device), data, 2, device)
    batch, sampler = data.draw(2).to(device), system.sampler
    sampler.update(2, system.field.density, step_generator(0, Stream.STEP, 2, device))
    before = sampler.capacity.per_ray
    steps, kept = before[False]
    narrow = {False: (steps, 0.4 * kept)}

    def sample_with_capacity(per_ray: dict[bool, tuple[float, float]]) -> Any:
        sampler.capacity.per_ray = per_ray
        return sampler(batch.rays, system.field.density, step_generator(0, Stream.STEP, 2, device))

    with torch.no_grad():
        counted, roomy, tight = sample_with_capacity({}), sample_with_capacity(before), sample_with_capacity(narrow)
    ends = counted.offsets.tolist()
    assert counted.complete is None and roomy.complete.all() and roomy.offsets.tolist() == ends
    torch.testing.assert_close(roomy.t[: ends[-1]].cpu(), counted.t.cpu())
    assert len(roomy) > len(counted) and not roomy.dt[ends[-1] :].any()
    assert tight.complete.tolist() == [end <= len(tight) for end in ends[1:]] and not tight.complete.all()

    def loss(pixels: torch.Tensor) -> float:
        sampler.capacity.per_ray = narrow
        changed = replace(batch, pixels=pixels)
        losses, _ = system.compute_losses(changed, step_generator(0, Stream.STEP, 2, device))
        return float(sum_losses(losses).detach())

    others = batch.pixels.clone()
    others[~tight.complete] = 255 - others[~tight.complete]
    assert loss(batch.pixels) == loss(others) > 0


@pytest.fixture(autouse=True)
def silence_lightning_hints() -> None:
    silence_lightning()


@pytest.mark.parametrize("name", MODELS)
def test_train_on_device_finishes(name: str, device_without_float64: torch.device, tmp_path: Path):
    train(compose_config([*small_options(name), *ON_DEVICE, "budget.steps=12"], tmp_path))
    found = json.loads((tmp_path / "results.json").read_text())
    assert found["device"] == NAME and found["machine"]["accelerator"] == NAME and found["steps"] == 12
    assert math.isfinite(found["psnr"]) and not found["recoveries"]
    assert (tmp_path / "snapshots").is_dir() and (tmp_path / "checkpoints" / "last.ckpt").exists()
    assert (tmp_path / "orbit.gif").exists() == (name in SCENES)
    assert PretendModule.synchronizations > 0, "clocks are read when the device has done its work"


def test_tools_run_of_cpu_work_on_device(device: torch.device, tmp_path: Path):
    """Evaluates, renders, exports and views a run."""
    run = tmp_path / "run"
    given = [*small_options("tensorf"), "device=cpu", "budget.steps=60", "~logger", "callbacks.orbit=null"]
    train(compose_config(given, run))
    judged = evaluate(run, output=tmp_path / "evaluation", worst=1, device=NAME)
    expected = json.loads((run / "results.json").read_text())["psnr"]
    assert judged["device"].startswith(NAME)
    assert fmean(view["psnr"] for view in judged["views"]) == pytest.approx(expected, abs=0.01)

    render(run, frames=2, channels="rgb,depth,opacity", output=tmp_path / "film.webp", device=NAME)
    render(run, path="test", output=tmp_path / "test_views", device=NAME)
    render(run, frames=1, background="transparent", output=tmp_path / "frames", device=NAME)
    assert (tmp_path / "film.webp").exists() and len(list((tmp_path / "frames").glob("*.png"))) == 1

    box = (-0.9, -0.9, -0.9, 0.9, 0.9, 0.9)
    written = [
        export_compact(run, output=tmp_path / "compact.npz", max_psnr_drop=3.0, device=NAME),
        export_mesh(run, output=tmp_path / "mesh.glb", resolution=24, box=box, device=NAME),
        export_points(run, output=tmp_path / "points.ply", resolution=24, device=NAME),
        export_voxels(run, output=tmp_path / "voxels.npz", resolution=24, device=NAME),
    ]
    assert all(file.stat().st_size > 100 for file in written)

    found = open_scene_run(run, device)
    for channel in ("rgb", "depth", "opacity"):
        request = ViewRequest(found.orbit.c2w[0].numpy(), 0.8, 1.5, channel, (1.0, 0.5, 0.0), 0.1, math.inf, 64)
        picture = ProgressiveRenderer(found.system, found.orbit).render(request, 24, lambda: True)
        assert picture.shape == (16, 24, 3) and picture.dtype == np.uint8 and picture.std() > 0
