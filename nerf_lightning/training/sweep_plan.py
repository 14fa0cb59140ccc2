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
    """A job of a sweep that has not started yet."""

    folder: str
    """Below the sweep's folder."""
    seconds: float | None
    """Its training budget; None if that is not in seconds."""


def planned(config: "DictConfig") -> list[PlannedJob]:
    """All jobs of a sweep in order; empty if the sweeper chooses them as it goes, or the launcher runs several at once."""
    if config.hydra.sweeper._target_ != GRID or config.hydra.launcher._target_ != IN_TURN:
        return []
    choices = {}  # as in Hydra, a later value of a key takes the place of an earlier one
    for override in _overrides(config):
        key = override.get_key_element()
        if override.is_sweep_override():
            choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
        else:
            choices[key] = [override.input_line or ""]
    fixed = fixed_keys([*config.hydra.overrides.task])
    jobs = []
    for overrides in itertools.product(*choices.values()):
        jobs.append(PlannedJob(job_name(overrides, fixed), _seconds(config, dict(_halves(overrides)))))
    return jobs


def devices_asked(config: "DictConfig") -> list[str]:
    """The devices that jobs on this machine ask for, as far as the command line tells."""
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
    """All overrides of a sweep, from its configuration and its command line."""
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
    """The progress of a sweep whose jobs are known in advance."""

    root: Path
    jobs: Sequence[PlannedJob]
    spent: list[tuple[float | None, float]] = field(default_factory=list)
    """Budget and wall-clock seconds of the jobs that this process ran."""
    _since: float = 0.0
    _open: bool = True

    def begin(self, number: int) -> str:
        """Called before a job. Returns a line on how far the sweep is."""
        self._since = time.monotonic()
        self._open = read_run(self.root / self.jobs[number].folder).status not in FINISHED
        left = self.seconds_left(number)
        told = "" if left is None else f", about {clock(left)} left"
        return f"job {number + 1} of {len(self.jobs)}{told}"

    def end(self, number: int) -> None:
        """Called after a job; the time of a failed or skipped one does not count."""
        if self._open and read_run(self.root / self.jobs[number].folder).status in FINISHED:
            self.spent.append((self.jobs[number].seconds, time.monotonic() - self._since))

    def seconds_left(self, number: int) -> float | None:
        """Seconds that this job and the later ones will take; None if nothing is known yet.

        A job takes its budget plus the average overhead so far; without a budget, the average time of a job.
        """
        left = [job for job in self.jobs[number:] if read_run(self.root / job.folder).status not in FINISHED]
        extra = [wall - (seconds or 0.0) for seconds, wall in self.spent]
        if not extra and any(job.seconds is None for job in left):
            return None
        besides = sum(extra) / len(extra) if extra else 0.0
        return sum((job.seconds or 0.0) + besides for job in left)
