"""python -m nerf_lightning.chart: which method is worth its time. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Reads the runs, compares them, writes the chart."""
    from nerf_lightning.chart.verb import chart_from

    chart_from(cfg)


def main() -> None:
    """The command line."""
    cli.run("chart", task, texts=("runs",))


if __name__ == "__main__":
    main()
