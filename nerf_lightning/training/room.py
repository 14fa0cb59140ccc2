"""Whether a training can fit into memory at all, from what its options say: told before it begins."""

import torch

from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.system import NeRF3D, System
from nerf_lightning.utils.memory import check_memory

RAY = 64
"""Bytes of a drawn ray: its place in the photos and its photo, whole numbers of 64 bits; origin, direction, colour and
truth."""
PIXEL = 36
"""Likewise of a place in a picture: its number of 64 bits, coordinates, colour and truth."""
SAMPLE = 32
"""Likewise of a sample: distance, length, number of its ray, density and colour."""


def check_room(system: System, data: RayDataModule | PixelDataModule, device: torch.device) -> None:
    """Refuses what certainly takes more memory than is free: the field at its largest, the sampler's grid, a step's rays and
    samples, a view's. What is counted is the least that each can take, so that what fits is never refused.

    Raises:
        InputError: for the first that does not fit, before anything is made.
    """
    field = system.field
    check_memory("config", "model", "numbers, with their gradients and moments,", field.training_bytes, device=device)
    layer = 4 * max((m.in_features for m in field.modules() if isinstance(m, torch.nn.Linear)), default=0)
    if isinstance(data, PixelDataModule):
        what = f"{data.pixels:,} pixels a step"
        check_memory("config", "dataset.pixels", what, data.pixels * (PIXEL + layer), device=device)
        return
    assert isinstance(system, NeRF3D)  # what build_system makes for rays
    sampler = system.sampler
    check_memory("config", "sampler.resolution", "cells", sampler.grid_bytes, device=device)
    rays, along = data.first_rays, sampler.first_samples
    what = f"{rays:,} rays a step, with {along:,} samples each,"
    todo = "give less of dataset.rays, sampler.samples or limits.batch"
    check_memory("config", "dataset.rays", what, rays * (RAY + along * (SAMPLE + layer)), todo, device)
    if data.samples is not None:
        aim = min(data.samples, rays * data.MOST_RAYS * along)  # rays adapt to it, within limits
        todo = "give less of dataset.samples or limits.batch"
        what = f"{aim:,} samples a step"
        check_memory("config", "dataset.samples", what, aim * (SAMPLE + layer), todo, device)
    view = int(data.scene.val.cameras.sizes.prod(1).max())
    together = min(system.chunk, view * along)
    what = f"{together:,} samples rendered at once"
    check_memory("config", "limits.chunk", what, together * (SAMPLE + layer), device=device)
