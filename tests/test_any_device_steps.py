"""Training steps on a device that is not the CPU: what they come to, and what they ask of it."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.count import Count
from nerf_lightning.kernels import use_kernels
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.system import total_loss
from nerf_lightning.utils.seeding import Stream, step_generator
from tests.helpers.device_runs import SAMPLERS, SCENES, options, stepped, system_of
from tests.helpers.fake_device import NAME
from tests.helpers.growth import grow
from tests.helpers.train_models import SCENE

VARIANTS = {
    **{name: options(name) for name in SCENES},
    **{
        name: [*(one for one in SCENE if not one.startswith("sampler.")), "model=mlp", "model.width=16", *given]
        for name, given in SAMPLERS.items()
    },
    "penalty, one colour behind": [
        *options("hashgrid"),
        "renderer.distortion_loss_weight=0.01",
        "renderer.background=white",
    ],
    "random colours behind": [*options("tensorf"), "renderer.background=random"],
}


@pytest.mark.parametrize(
    ("variant", "kind"), list(zip(VARIANTS, itertools.cycle(["alpha", "unbounded"]), strict=False))
)
def test_steps_on_device_match_steps_on_cpu(variant: str, kind: str, without_doubles: torch.device, tmp_path: Path):
    device = without_doubles
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
    """As of a scene with a background."""
    for part in (system.field, system.sampler):
        part._bounds = replace(part._bounds, unbounded=True)


MOST = {"tensorf": 255, "hashgrid": 255, "voxels": 255, "mlp": 225}
"""Operations a step between two updates of the sampler: forward, backward, optimiser. Each takes 5 to 10 microseconds."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "hashgrid" else pytest.mark.long) for name in MOST]
)
def test_step_on_device_needs_few_operations_and_no_wait(name: str, device: torch.device, tmp_path: Path):
    """As shipped, of a field that has its size; reading a result, or its size, makes the host wait."""
    small = ["dataset=bricks", "dataset.size=24", "dataset.train_views=8", "dataset.val_views=1"]
    system, data = system_of([f"recipe={name}_medium", *small, "sampler.warmup=0"], tmp_path)
    assert isinstance(system, NeRF3D)
    system, period, counts = system.to(device), system.sampler.update_every, []
    optimizer = system.configure_optimizers()
    for step in range(2 * period):
        grow(system.field, 0.9)
        batch = data.draw(step).to(device)
        with Count() as count:
            generator = step_generator(0, Stream.STEP, step, device)
            system.sampler.update(step, system.field.density, generator)
            losses, stats = system.compute_losses(batch, generator)
            total_loss(losses).backward()
            optimizer.step()
            optimizer.zero_grad()
        if stats.counted:
            data.note_samples(stats.samples)
        counts.append(count)
    for count in counts[-period + 3 :]:  # the first ones after an update make what is then kept for the device
        assert count.operations <= MOST[name], count.names.most_common()
        assert count.waits == 0, count.names.most_common()
    assert 0 < sum(count.waits for count in counts[-period:]) <= 8, "for an update"


@pytest.mark.parametrize("name", ["hashgrid2d", "picture_mlp", "fourier", "siren"])
def test_picture_step_on_device_needs_no_wait(name: str, device: torch.device, tmp_path: Path):
    system, data = system_of(options(name), tmp_path)
    optimizer, batch = system.to(device).configure_optimizers(), data.draw(0).to(device)
    for _ in range(2):
        with Count() as count:
            system.training_step(batch, 0).backward()
            optimizer.step()
            optimizer.zero_grad()
    assert count.waits == 0 and count.operations <= 100, count.names.most_common()


def test_rays_beyond_room_do_not_train(device: torch.device, tmp_path: Path):
    system, data = system_of(options("hashgrid"), tmp_path)
    assert isinstance(system, NeRF3D)
    stepped(system.to(device), data, 2, device)
    batch, sampler = data.draw(2).to(device), system.sampler
    sampler.update(2, system.field.density, step_generator(0, Stream.STEP, 2, device))
    before = sampler.counts_per_ray
    assert before is not None, "there is room for as many as were counted"

    def drawn(per_ray: tuple[float, float] | None) -> Any:
        sampler.counts_per_ray = per_ray
        return sampler(batch.rays, system.field.density, step_generator(0, Stream.STEP, 2, device))

    with torch.no_grad():
        counted, roomy, tight = drawn(None), drawn(before), drawn((before[0], 0.4 * before[1]))
    assert counted.whole is None and roomy.whole.all() and len(roomy) > len(counted)
    ends = [int(end) for end in counted.offsets.cpu()]
    torch.testing.assert_close(roomy.t[: ends[-1]].cpu(), counted.t.cpu())
    assert torch.equal(roomy.offsets.cpu(), counted.offsets.cpu()) and not roomy.dt[ends[-1] :].any()
    whole = tight.whole.cpu()
    assert whole.tolist() == [end <= len(tight) for end in ends[1:]] and 0 < int(whole.sum()) < len(whole)
    assert torch.equal(tight.t[: ends[int(whole.sum())]].cpu(), counted.t[: ends[int(whole.sum())]].cpu())

    def loss(pixels: torch.Tensor) -> float:
        sampler.counts_per_ray = (before[0], 0.4 * before[1])
        changed = replace(batch, pixels=pixels)
        losses, _ = system.compute_losses(changed, step_generator(0, Stream.STEP, 2, device))
        return float(total_loss(losses).detach())

    others = batch.pixels.clone()
    others[~tight.whole] = 255 - others[~tight.whole]
    assert loss(batch.pixels) == loss(others) > 0
