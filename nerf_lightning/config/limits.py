"""Device limits: how much is processed at once, by default for each kind of device in conf/devices."""

from dataclasses import dataclass

import torch
import yaml
from omegaconf import DictConfig

from nerf_lightning.config import conf_dir
from nerf_lightning.utils.option_checks import Count, check_options


@dataclass(frozen=True)
class Limits:
    """The keys of conf/devices/*.yaml, and of a run's `limits`."""

    batch_scale: Count
    """Factor on the rays and samples of a training step."""
    chunk_samples: Count
    """Samples rendered at once."""


def get_limits(cfg: DictConfig, device: torch.device) -> Limits:
    """Limits of a run, or else the defaults of its device.

    Raises:
        InputError: for an unknown limit, or one below 1.
    """
    folder = conf_dir() / "devices"
    file = folder / f"{device.type}.yaml"
    limits = yaml.safe_load((file if file.exists() else folder / "cpu.yaml").read_text(encoding="utf-8"))
    limits |= {str(key): value for key, value in cfg.get("limits", {}).items() if value is not None}
    check_options("limits", Limits, limits)
    return Limits(**limits)
