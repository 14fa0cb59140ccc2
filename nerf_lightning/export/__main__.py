"""python -m nerf_lightning.export: a run as something else. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli
from nerf_lightning.export.order import Order
from nerf_lightning.utils.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and exports."""
    given = cli.given_of(cfg)
    check_options("", Order, given)

    from nerf_lightning.export.verb import export

    export(Order(**given))


if __name__ == "__main__":
    cli.run("export", task, texts=("run", "output", "dataset.path"))
