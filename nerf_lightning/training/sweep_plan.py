"""How far a sweep is, and how long it will take."""

import itertools
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
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
    extra: list[float] = field(default_factory=list)
    """Wall-clock seconds of the jobs that this process ran, beyond their budgets: starting and rendering."""
    _since: float = 0.0
    _open: bool = True
    _job: PlannedJob | None = None
    _later: Sequence[PlannedJob] = ()

    def begin(self, number: int) -> str:
        """Called before a job. Returns a line on how far the sweep is."""
        self._since, self._job = time.monotonic(), self.jobs[number]
        self._open, *later = (not self._finished(job) for job in self.jobs[number:])
        self._later = list(itertools.compress(self.jobs[number + 1 :], later))
        told = ""
        if self.extra:
            job_left = (self._job.seconds or 0.0) + fmean(self.extra) if self._open else 0.0
            told = f", about {clock(self.seconds_left(job_left))} left"
        return f"job {number + 1} of {len(self.jobs)}{told}"

    def end(self, number: int) -> None:
        """Called after a job; the time of a failed or skipped one does not count."""
        if self._open and self._finished(self.jobs[number]):
            self.extra.append(time.monotonic() - self._since - (self.jobs[number].seconds or 0.0))

    def _finished(self, job: PlannedJob) -> bool:
        return read_run(self.root / job.folder).status in FINISHED

    def seconds_left(self, job_left: float) -> float:
        """Seconds that this job and the later ones will take, from those that this one will: the later ones take their budgets
        and, on average, as long beside as those so far and this one; without budgets, the average time of a job."""
        extra = list(self.extra)
        if self._job is not None and self._open:
            extra.append(time.monotonic() - self._since + job_left - (self._job.seconds or 0.0))
        return job_left + sum((job.seconds or 0.0) + fmean(extra) for job in self._later)
