"""Objects to measure on, built as a run builds them."""

from pathlib import Path

import torch
from omegaconf import DictConfig

from nerf_lightning.config.build import build_data, build_system, frame_of
from nerf_lightning.config.compose import composed
from nerf_lightning.config.limits import limits_of
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.system import NeRF3D
from nerf_lightning.training.train import prepare
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.libraries import silence_lightning

METHODS = ("tensorf", "hashgrid", "voxels", "mlp")
"""In 3D; the recipe of each in its usual size ends in _medium."""


def on_device(device: torch.device) -> list[str]:
    """Overrides with which a run trains there."""
    return [f"device={device.type}"]


def built(overrides: list[str], folder: Path, device: torch.device = CPU) -> tuple[DictConfig, RayDataModule, NeRF3D]:
    """Configuration, data and system of a 3D run, the process prepared as for training on a device, the system there."""
    cfg = composed(overrides, folder)
    silence_lightning()
    prepare(cfg)
    data = build_data(cfg)
    data.enlarge(limits_of(cfg, device).batch)
    system = build_system(cfg, frame_of(data), device).to(device)
    if not isinstance(system, NeRF3D) or not isinstance(data, RayDataModule):
        raise TypeError("only 3D runs are measured here")
    return cfg, data, system
