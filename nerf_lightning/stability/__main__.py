"""python -m nerf_lightning.stability: methods tried where they are known to fail. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING, Annotated

from nerf_lightning.config import cli
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import output_path
from nerf_lightning.utils.options import AtMost, Count, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and tries all cells."""
    from omegaconf import OmegaConf

    given = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(given, dict)  # a DictConfig gives nothing else
    plain = {str(key): value for key, value in given.items()}
    check_options("", stability, plain)
    stability(**plain)


def stability(
    suite: str,
    methods: list[str] | None,
    seeds: Annotated[Count, AtMost(1000)],
    steps: Count,
    workers: Count | None,
    output: str,
) -> None:
    """Trains all cells and writes what became of them. A thousand seeds tell the share that fails to 1.6 %.

    Raises:
        InputError: for a suite or a method that is not known, and a folder that another process writes into.
    """
    from contextlib import closing

    from nerf_lightning.runs.owner import owned
    from nerf_lightning.stability.conditions import CONDITIONS
    from nerf_lightning.stability.methods import METHODS
    from nerf_lightning.stability.report import write_report
    from nerf_lightning.stability.suite import QUICK, cells_of, run_all
    from nerf_lightning.utils.progress import tracked

    every = [condition.name for condition in CONDITIONS]
    if suite not in ("quick", "full"):
        raise InputError("config", "suite", repr(suite), "quick or full")
    unknown = [method for method in methods or [] if method not in METHODS]
    if unknown or methods == []:
        found = unknown[0] if unknown else "none"
        raise InputError("config", "methods", found, f"some of {', '.join(METHODS)}")
    cells = cells_of(QUICK if suite == "quick" else every, methods or list(METHODS), seeds, steps)
    root = output_path(output)
    with owned(root), closing(run_all(cells, root, workers)) as done:  # also where a signal comes between two of them
        outcomes = dict(tracked(done, len(cells), "cells"))
        write_report([outcomes[cell] for cell in cells], suite, root)


if __name__ == "__main__":
    cli.run("stability", task)
