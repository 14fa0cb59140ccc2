"""RenderPlan: what a run renders beside its training, so that it takes no longer than that and its end can be told."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass

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


def allot(needs: Mapping[str, float], allowance: float) -> dict[str, float]:
    """Weighted max-min fair shares: no job gets more than it needs, and what it leaves is divided among the others.

    Args:
        needs: seconds by job.
        allowance: seconds for all of them.
    """
    shares: dict[str, float] = {}
    for job in sorted(needs, key=lambda job: needs[job] / PRIORITY[job]):
        weight = PRIORITY[job] / sum(PRIORITY[other] for other in needs if other not in shares)
        shares[job] = min(needs[job], weight * max(0.0, allowance - sum(shares.values())))
    return shares


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

    def cost(self, need: Need) -> float:
        """Seconds that a job takes at full quality."""
        return need.pixels * ((self.pixel_seconds or 0.0) + need.scored * self.score_seconds)

    def divide(self, needs: Mapping[str, Need], allowance: float) -> dict[str, float]:
        """Seconds of each job, of an allowance for all rendering of the run."""
        whole = {job: self.cost(need) for job, need in needs.items()}
        bounded = {job: need for job, need in needs.items() if not need.asked}
        least = {job: whole[job] * min(need.least / max(need.pixels, 1.0), 1.0) for job, need in bounded.items()}
        more = allot({job: whole[job] - least[job] for job in bounded}, allowance - self.spent - sum(least.values()))
        return whole | {job: least[job] + more[job] for job in bounded}

    def share(self, job: str, needs: Mapping[str, Need], allowance: float) -> float:
        """The share of its pixels that a job may render, one of `needs`."""
        whole = self.cost(needs[job])
        return min(1.0, self.divide(needs, allowance)[job] / whole) if whole else 1.0

    def seconds_left(self, needs: Mapping[str, Need], allowance: float) -> float | None:
        """Of all jobs together; None before the first view."""
        return None if self.pixel_seconds is None else sum(self.divide(needs, allowance).values())
