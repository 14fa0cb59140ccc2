"""python -m nerf_lightning.export: a run as something else. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning import cli
from nerf_lightning.export.order import Order
from nerf_lightning.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and exports."""
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if key != "dataset" and not OmegaConf.is_missing(cfg, key)}
    given |= {key: OmegaConf.to_container(value) for key, value in given.items() if OmegaConf.is_config(value)}
    given["photos"] = cfg.dataset.path
    check_options("", Order, given)

    from nerf_lightning.export.verb import export

    export(Order(**given))


if __name__ == "__main__":
    cli.run("export", task, texts=("run", "output", "dataset.path"))
