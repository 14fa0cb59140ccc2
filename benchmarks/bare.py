"""A training step without Lightning: what it costs by itself."""

import time

import torch

from nerf_lightning.dataset import RayDataModule
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.device import synchronize
from nerf_lightning.utils.seeding import Stream, step_generator


def bare_step(
    system: NeRF3D, data: RayDataModule, optimizer: torch.optim.Optimizer, step: int, progress: float
) -> float:
    """One step as NeRF3D does it under a Trainer, on the system's device. Returns its seconds."""
    synchronize(system.device)
    start = time.perf_counter()
    system.progress = progress
    for group in optimizer.param_groups:
        group["lr"] = group["initial_lr"] * system.schedule(progress, step)
    for parameter in system.field.grow(system.ripeness(step)):
        optimizer.state.pop(parameter, None)
    system.follow_field(data)
    batch = data.draw(step).to(system.device)
    optimizer.zero_grad()
    loss, system.stats = system.loss(batch, step_generator(system.seed, Stream.STEP, step, system.device), step)
    loss.backward()
    optimizer.step()
    assert system.stats.squares is not None  # a NeRF3D's
    data.note_errors(system.stats.squares, system.stats.whole)
    if system.stats.counted:
        data.note_samples(system.stats.samples)
    synchronize(system.device)
    return time.perf_counter() - start
