"""python -m nerf_lightning.inspect: a look at photos and cameras before training. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING, Annotated

from nerf_lightning.config import cli
from nerf_lightning.utils.options import AtLeast, Count, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def options(
    scene: str,
    output: str | None,
    resize: Count | None,
    holdout: Annotated[int, AtLeast(2)],
    masked: str,
    invert_masks: bool,
    undistort: bool,
    bounded: str | bool,
    orientation: str,
) -> None:
    """The keys of conf/inspect.yaml, for checking."""


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and writes the page.

    Raises:
        InputError: a wrong key, or no scene there.
    """
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if not OmegaConf.is_missing(cfg, key)}
    check_options("", options, given)

    from nerf_lightning.inspect.verb import inspect

    inspect(**given)


if __name__ == "__main__":
    cli.run("inspect", task, texts=("scene", "output"))
