"""RenderPlan: what a run renders beside its training, so that it takes no longer than that and its end can be told."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

import lightning as L

MIN_SECONDS = 30.0
"""Rendering may always take this long, however short the training is."""
PRIORITY = {"final": 30.0, "aligned": 1.0, "test": 1.0, "curve": 1.0, "snapshots": 1.0, "orbit": 1.0}
"""Weights of the jobs where there is not time for all: pictures and curves become smaller before the final figure does."""
SMOOTHING = 0.7
"""Weight of the last view in the seconds that a pixel takes."""
PROBE_PIXELS = 1 << 14
"""Pixels whose time tells what others take; fewer count less."""


@dataclass(frozen=True)
class Need:
    """What a job still has to render."""

    pixels: float
    """At full quality."""
    least: float = 0.0
    """Pixels that are rendered however little time there is."""
    scored: bool = False
    """Whether SSIM is computed of them."""
    asked: bool = False
    """Whether the user asked for it: it is then rendered in any case, in time of its own."""


class Renders(L.Callback):
    """A callback that renders views."""

    def needs(self, trainer: L.Trainer) -> dict[str, Need]:
        """What is still to be rendered, by job."""
        raise TypeError(f"{type(self).__name__} must define needs(trainer)")


def needs_of(trainer: L.Trainer) -> dict[str, Need]:
    """What all callbacks still have to render, by job."""
    found: dict[str, Need] = {}
    for callback in trainer.callbacks:  # type: ignore[attr-defined]
        if isinstance(callback, Renders):
            found |= callback.needs(trainer)
    return found


def allot(needs: Mapping[str, float], allowance: float) -> dict[str, float]:
    """Weighted max-min fair shares: no job gets more than it needs, and what it leaves is divided among the others.

    Args:
        needs: seconds by job.
        allowance: seconds for all of them.
    """
    given: dict[str, float] = {}
    left = dict(needs)
    while left:
        unit = max(0.0, allowance) / sum(PRIORITY[job] for job in left)
        modest = [job for job in left if left[job] <= unit * PRIORITY[job]]
        if not modest:
            return given | {job: unit * PRIORITY[job] for job in left}
        for job in modest:
            allowance -= left[job]
            given[job] = left.pop(job)
    return given


class RenderPlan:
    """Divides the time for rendering among a run's jobs by the time that a pixel takes, and says what is being rendered."""

    def __init__(self) -> None:
        self.spent = 0.0
        """Seconds of rendering so far."""
        self.pixel_seconds: float | None = None
        """Of rendering; None before the first view."""
        self.score_seconds = 0.0
        """Of SSIM, for each pixel."""
        self.subject = ""
        """What is being rendered."""
        self._listeners: list[Callable[[], None]] = []

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Calls it whenever something else is being rendered."""
        self._listeners.append(listener)

    @contextmanager
    def rendering(self, subject: str) -> Iterator[None]:
        """Counts the time of a block as rendering."""
        self.start(subject)
        try:
            yield
        finally:
            self.stop()

    def start(self, subject: str) -> None:
        """The same where the block is not one."""
        self.subject, self._since = subject, time.perf_counter()
        for listener in self._listeners:
            listener()

    def stop(self) -> None:
        self.spent += time.perf_counter() - self._since
        self.subject = ""

    def note(self, pixels: int, seconds: float) -> None:
        """Called with the time that a view took."""
        if self.pixel_seconds is None:
            self.pixel_seconds = seconds / pixels
        else:
            weight = SMOOTHING * min(1.0, pixels / PROBE_PIXELS)
            self.pixel_seconds += weight * (seconds / pixels - self.pixel_seconds)

    def _cost(self, need: Need) -> float:
        """Seconds that a pixel of a job takes."""
        return (self.pixel_seconds or 0.0) + need.scored * self.score_seconds

    def _divide_seconds(self, needs: Mapping[str, Need], allowance: float) -> dict[str, float]:
        """Seconds of each job: what it renders in any case, and a share of the time beside."""
        least, more = {}, {}
        for job, need in needs.items():
            least[job] = self._cost(need) * (need.pixels if need.asked else min(need.least, need.pixels))
            more[job] = self._cost(need) * need.pixels - least[job]
        bounded = [job for job, need in needs.items() if not need.asked]
        rest = allowance - self.spent - sum(least[job] for job in bounded)
        shares = allot({job: more[job] for job in bounded}, rest)
        return {job: least[job] + shares.get(job, 0.0) for job in needs}

    def share(self, job: str, needs: Mapping[str, Need], allowance: float) -> float:
        """The share of its pixels that a job may render.

        Args:
            job: one of `needs`.
            needs: of all jobs.
            allowance: seconds for all rendering of the run.
        """
        needed = self._cost(needs[job]) * needs[job].pixels
        return min(1.0, self._divide_seconds(needs, allowance)[job] / needed) if needed else 1.0

    def seconds_left(self, needs: Mapping[str, Need], allowance: float) -> float | None:
        """Of all jobs together; None before the first view."""
        return None if self.pixel_seconds is None else sum(self._divide_seconds(needs, allowance).values())
