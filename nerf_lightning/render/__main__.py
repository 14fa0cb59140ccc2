"""python -m nerf_lightning.render: a run along a camera path. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli
from nerf_lightning.render.options import RenderOptions
from nerf_lightning.utils.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and renders."""
    given = cli.given_of(cfg)
    check_options("", RenderOptions, given)

    from nerf_lightning.render.verb import render

    render(RenderOptions(**given))


if __name__ == "__main__":
    cli.run("render", task, texts=("run", "path", "output", "background", "channels"))
