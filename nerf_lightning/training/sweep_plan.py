"""How far a sweep is, and how long it will take."""

import itertools
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from omegaconf import OmegaConf

from nerf_lightning.callbacks.progress import clock
from nerf_lightning.config.resolvers import fixed_keys, job_name
from nerf_lightning.runs.index import FINISHED, read_run

if TYPE_CHECKING:
    from omegaconf import DictConfig

GRID = "hydra._internal.core_plugins.basic_sweeper.BasicSweeper"
IN_TURN = "hydra._internal.core_plugins.basic_launcher.BasicLauncher"
HERE = ("BasicLauncher", "JoblibLauncher", "LocalLauncher")
"""Launchers whose jobs run on this machine."""


@dataclass(frozen=True)
class PlannedJob:
    """One job that a sweep will start."""

    folder: str
    """Below the sweep's."""
    seconds: float | None
    """Its training budget; None where that is not in seconds."""


def planned(config: "DictConfig") -> list[PlannedJob]:
    """All jobs of a sweep in their order; none where a sweeper thinks of them on the way, or a launcher starts several."""
    if config.hydra.sweeper._target_ != GRID or config.hydra.launcher._target_ != IN_TURN:
        return []
    choices = []
    for override in _overrides(config):
        key = override.get_key_element()
        if override.is_sweep_override():
            choices.append([f"{key}={value}" for value in override.sweep_string_iterator()])
        else:
            choices.append([override.input_line or ""])
    fixed = fixed_keys([*config.hydra.overrides.task])
    jobs = []
    for overrides in itertools.product(*choices):
        jobs.append(PlannedJob(job_name(overrides, fixed), _seconds(config, dict(_halves(overrides)))))
    return jobs


def devices_asked(config: "DictConfig") -> list[str]:
    """The devices that the jobs of a sweep ask for, as far as its command line says, where they run on this machine."""
    if config.hydra.launcher._target_.rsplit(".", 1)[-1] not in HERE:
        return []
    swept = [
        value.strip("'\"")
        for override in _overrides(config)
        if override.get_key_element() in ("device", "trainer.accelerator") and override.is_sweep_override()
        for value in override.sweep_string_iterator()
    ]
    return swept or [str(OmegaConf.select(config, "trainer.accelerator", default="auto"))]


def _overrides(config: "DictConfig") -> list[Override]:
    """Of a sweep's configuration and its command line."""
    swept = [f"{key}={value}" for key, value in (config.hydra.sweeper.get("params") or {}).items()]
    return OverridesParser.create().parse_overrides([*swept, *config.hydra.overrides.task])


def _halves(overrides: Iterable[str]) -> Iterator[tuple[str, str]]:
    for override in overrides:
        key, _, value = override.partition("=")
        yield key, value


def _seconds(config: "DictConfig", overrides: dict[str, str]) -> float | None:
    """A job's budget in seconds, if that is what ends it."""
    steps, seconds = (overrides.get(f"budget.{unit}", config.budget[unit]) for unit in ("steps", "seconds"))
    if seconds in (None, "null") and steps in (None, "null"):
        seconds = config.budget.default.get("seconds")
    return None if seconds in (None, "null") else float(seconds)


@dataclass
class SweepProgress:
    """Follows a sweep whose jobs are known beforehand."""

    root: Path
    jobs: Sequence[PlannedJob]
    spent: list[tuple[float | None, float]] = field(default_factory=list)
    """Budget and wall-clock seconds of the jobs that this process ran."""
    _since: float = 0.0
    _open: bool = True

    def begin(self, number: int) -> str:
        """Called before a job. Returns where the sweep stands, in words."""
        self._since = time.monotonic()
        self._open = read_run(self.root / self.jobs[number].folder).status not in FINISHED
        left = self.seconds_left(number)
        told = "" if left is None else f", about {clock(left)} left"
        return f"job {number + 1} of {len(self.jobs)}{told}"

    def end(self, number: int) -> None:
        """Called after a job; one that failed, or was skipped because it was done before, says nothing about time."""
        if self._open and read_run(self.root / self.jobs[number].folder).status in FINISHED:
            self.spent.append((self.jobs[number].seconds, time.monotonic() - self._since))

    def seconds_left(self, number: int) -> float | None:
        """Seconds that this job and the later ones will take; None before there is anything to go by.

        A job takes its budget and what was needed besides on average so far; without a budget, what jobs took on average.
        """
        left = [job for job in self.jobs[number:] if read_run(self.root / job.folder).status not in FINISHED]
        extra = [wall - (seconds or 0.0) for seconds, wall in self.spent]
        if not extra and any(job.seconds is None for job in left):
            return None
        besides = sum(extra) / len(extra) if extra else 0.0
        return sum((job.seconds or 0.0) + besides for job in left)
