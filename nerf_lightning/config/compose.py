"""Composes configurations as the command line does, for code that runs without one: the front door, tests, benchmarks."""

from pathlib import Path

from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict

from nerf_lightning.config import conf_dir, resolvers  # noqa: F401  (conf/ uses the resolvers)
from nerf_lightning.config.keys import check_keys, without_nulls
from nerf_lightning.config.literal import escape


def composed(overrides: list[str], folder: Path, config: str = "config") -> DictConfig:
    """The configuration that a command line would give to the verb `config`, with `folder` as the run's."""
    with initialize_config_dir(str(conf_dir()), version_base="1.3"):
        cfg = compose(config, without_nulls(overrides), return_hydra_config=True)
    with open_dict(cfg):
        cfg.hydra.runtime.output_dir = escape(str(folder))
    HydraConfig.instance().set_config(cfg)
    own = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    check_keys(own, config, cfg.hydra.runtime.choices)
    return own
