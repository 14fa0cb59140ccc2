"""Objects to measure on, built as a run builds them."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from nerf_lightning.build import build_data, build_system, frame_of
from nerf_lightning.cli import conf_dir
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.system import NeRF3D
from nerf_lightning.training import prepare_process, quiet


def composed(overrides: list[str], folder: Path) -> DictConfig:
    """The configuration that a command line with these overrides would give, with `folder` as the run's."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("config", overrides, return_hydra_config=True)
    with open_dict(cfg):
        cfg.hydra.runtime.output_dir = str(folder)
    HydraConfig.instance().set_config(cfg)
    return OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])


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
