"""python -m nerf_lightning.chart: which method is worth its time. Heavy imports wait until there is work."""

import sys
from typing import TYPE_CHECKING

from nerf_lightning import cli
from nerf_lightning.chart.verb import quoted

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Reads the runs, compares them, writes the chart."""
    from nerf_lightning.chart.verb import chart_from

    chart_from(cfg)


def main() -> None:
    """The command line."""
    sys.argv[1:] = quoted(sys.argv[1:])
    cli.run("chart", task)


if __name__ == "__main__":
    main()
