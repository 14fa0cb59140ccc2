"""python -m nerf_lightning.chart: which method is worth its time. Heavy imports wait until there is work."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerf_lightning.config import cli
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import output_path, user_path
from nerf_lightning.utils.options import AtLeast, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def options(
    runs: str | list[str],
    output: str | None,
    within_db: Annotated[float, AtLeast(0)],
    seconds: Annotated[float, AtLeast(0)],
    smallest_within_db: Annotated[float, AtLeast(0)],
    references: dict | None = None,
) -> None:
    """The keys of conf/chart.yaml, for checking."""


def task(cfg: "DictConfig") -> None:
    """Reads the runs, compares them, writes the chart.

    Raises:
        InputError: a key that is missing or wrong, a folder that is not there or holds no run.
    """
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if not OmegaConf.is_missing(cfg, key)}
    given |= {key: OmegaConf.to_container(value) for key, value in given.items() if OmegaConf.is_config(value)}
    if not given.get("runs"):
        raise InputError("config", "runs", "nothing", "folders with runs", "give runs=outputs/pareto")
    check_options("", options, given)
    folders = (
        split_folders(given["runs"]) if isinstance(given["runs"], str) else [user_path(one) for one in given["runs"]]
    )
    output = folders[0] / "chart" if given["output"] is None else output_path(given["output"])

    from nerf_lightning.chart.references import read_references
    from nerf_lightning.chart.report import write_report
    from nerf_lightning.runs.index import find_runs

    references = read_references(given.get("references") or {})
    found = {run.folder.resolve(): run for folder in folders for run in find_runs(folder)}
    limits = (given["within_db"], given["seconds"], given["smallest_within_db"])
    write_report(list(found.values()), references, limits, output)


def split_folders(text: str) -> list[Path]:
    """Folders separated by commas. A sweep's job folders have commas in their names: the longest name that exists counts."""
    parts, folders = text.split(","), []
    while parts:
        longest = next(
            (n for n in range(len(parts), 0, -1) if os.path.isdir(os.path.expanduser(",".join(parts[:n])))), 1
        )
        folders.append(user_path(",".join(parts[:longest])))
        parts = parts[longest:]
    return folders


def main() -> None:
    """The command line."""
    cli.run("chart", task, texts=("runs",))


if __name__ == "__main__":
    main()
