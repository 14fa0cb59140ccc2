"""python -m nerf_lightning.gallery: the figure of any sweep, from its folder alone. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli
from nerf_lightning.utils.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def options(runs: str, output: str | None) -> None:
    """The keys of conf/gallery.yaml, for checking."""


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and draws."""
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if not OmegaConf.is_missing(cfg, key)}
    check_options("", options, given)

    from nerf_lightning.gallery.verb import gallery

    gallery(**given)


if __name__ == "__main__":
    cli.run("gallery", task)
