"""Objects to measure on, built as a run builds them."""

from pathlib import Path

import torch
from omegaconf import DictConfig

from nerf_lightning.build import build_data, build_system, frame_of
from nerf_lightning.compose import composed
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.system import NeRF3D
from nerf_lightning.training import prepare_process, quiet

METHODS = ("tensorf", "hashgrid", "voxels", "mlp")
"""In 3D; the recipe of each in its usual size ends in _medium."""


def on_device(device: torch.device) -> list[str]:
    """Overrides with which a run trains there."""
    return [f"trainer.accelerator={device.type}"]


def built(overrides: list[str], folder: Path) -> tuple[DictConfig, RayDataModule, NeRF3D]:
    """Configuration, data and system of a 3D run, the process prepared as for training."""
    cfg = composed(overrides, folder)
    quiet()
    prepare_process(cfg.seed, cfg.threads, cfg.kernels)
    data = build_data(cfg)
    system = build_system(cfg, frame_of(data))
    if not isinstance(system, NeRF3D) or not isinstance(data, RayDataModule):
        raise TypeError("only 3D runs are measured here")
    return cfg, data, system
