"""python -m nerf_lightning.render: a run along a camera path. Heavy imports wait until there is work."""

import sys
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

    try:
        render(RenderOptions(**given))
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from here", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    cli.run("render", task, texts=("run", "path", "output", "background", "channels"))
