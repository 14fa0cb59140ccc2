"""A training loop without Lightning: what a step costs by itself."""

import time

from nerf_lightning.dataset import RayDataModule
from nerf_lightning.seeding import step_generator
from nerf_lightning.system import NeRF3D


def bare_loop(system: NeRF3D, data: RayDataModule, steps: int) -> list[float]:
    """Trains for `steps` steps as NeRF3D does under a Trainer. Returns the seconds of each step."""
    optimizer = system.configure_optimizers()
    seconds = []
    for step in range(steps):
        start = time.perf_counter()
        system.progress = step / steps
        for group in optimizer.param_groups:
            group["lr"] = group["initial_lr"] * system.schedule(system.progress)
        for parameter in system.field.grow(system.progress):
            optimizer.state.pop(parameter, None)
        batch = data.draw(step)
        optimizer.zero_grad()
        loss, stats = system.loss(batch, step_generator(system.seed, 1, step, system.device), step)
        loss.backward()
        optimizer.step()
        data.adapt(stats.samples)
        seconds.append(time.perf_counter() - start)
    return seconds
