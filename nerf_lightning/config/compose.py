"""Composes configurations without a command line, for the Python API, tests and benchmarks."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from nerf_lightning.config import conf_dir, resolvers  # noqa: F401  (conf/ uses the resolvers)
from nerf_lightning.config.options import check_run_options, replace_nulls
from nerf_lightning.config.quoting import escape_interpolations


def compose_config(overrides: list[str], folder: Path) -> DictConfig:
    """Composes the configuration that a command line would train with, for the run folder `folder`."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose("config", replace_nulls(overrides), return_hydra_config=True)
    with open_dict(cfg):
        cfg.hydra.runtime.output_dir = escape_interpolations(str(folder))
    HydraConfig.instance().set_config(cfg)
    run_cfg = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    check_run_options(run_cfg, cfg.hydra.runtime.choices)
    return run_cfg
