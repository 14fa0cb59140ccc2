"""python -m nerf_lightning.export: a run as something else. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli
from nerf_lightning.export.options import ExportOptions
from nerf_lightning.utils.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and exports."""
    given = cli.given_of(cfg)
    check_options("", ExportOptions, given)

    from nerf_lightning.export.verb import export

    export(ExportOptions(**given))


if __name__ == "__main__":
    cli.run("export", task, texts=("run", "output", "dataset.path"))
