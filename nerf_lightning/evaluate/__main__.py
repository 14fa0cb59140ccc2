"""python -m nerf_lightning.evaluate: how good a run is, view by view. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli
from nerf_lightning.utils.options import Count, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def options(run: str, output: str | None, worst: Count, device: str, split: str, photos: str | None) -> None:
    """The keys of conf/evaluate.yaml, for checking; `photos` is its dataset.path."""


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and evaluates."""
    given = cli.given_of(cfg)
    check_options("", options, given)

    from nerf_lightning.evaluate.verb import evaluate

    evaluate(**given)


if __name__ == "__main__":
    cli.run("evaluate", task, texts=("run", "output", "dataset.path"))
