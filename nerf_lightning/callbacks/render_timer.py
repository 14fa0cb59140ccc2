"""Render timing: limits rendering to the training time, and predicts when it ends."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

MIN_RENDER_SECONDS = 30.0
"""Rendering time that is always allowed, however short the training."""
MIN_RENDER_FRACTION = 0.01
"""Fraction of its pixels that each job may always render."""
EMA_WEIGHT = 0.7
"""Weight of the last view in the running mean of seconds per pixel."""
PROBE_PIXELS = 1 << 14
"""Pixels of a timing probe; smaller renders get less weight."""
Job = TypeVar("Job")


def allocate_max_min_fair(
    costs: Mapping[Job, float], weights: Mapping[Job, float], allowance: float
) -> dict[Job, float]:
    """Weighted max-min fair shares: no job gets more than its cost; what it leaves is divided among the others.

    Args:
        costs, weights: seconds and weight of each job.
        allowance: seconds for all jobs; each gets `MIN_RENDER_FRACTION` of its cost in any case.
    """
    shares: dict[Job, float] = {}
    rest = max(0.0, allowance - MIN_RENDER_FRACTION * sum(costs.values()))
    for job in sorted(costs, key=lambda job: costs[job] / weights[job]):
        weight = weights[job] / sum(weights[other] for other in costs if other not in shares)
        least = MIN_RENDER_FRACTION * costs[job]
        shares[job] = min(costs[job], least + weight * rest)  # exactly its cost, as less would leave rows out
        rest -= shares[job] - least
    return shares


class RenderTimer:
    """Times rendering, tracks the seconds per pixel, and names what is being rendered."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.seconds_per_pixel: float | None = None
        """Running mean; None before the first view."""
        self.subject = ""
        self._listener: Callable[[], None] = lambda: None

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Calls `listener` whenever the subject changes."""
        self._listener = listener

    @contextmanager
    def measure(self, subject: str) -> Iterator[None]:
        """Times a block as rendering."""
        self.start(subject)
        try:
            yield
        finally:
            self.stop()

    def start(self, subject: str) -> None:
        """Starts timing, where `measure` does not fit."""
        self.subject, self._since = subject, time.perf_counter()
        self._listener()

    def stop(self) -> None:
        self.seconds += time.perf_counter() - self._since
        self.subject = ""

    def add_timing(self, pixels: int, seconds: float) -> None:
        """Updates the seconds per pixel with a rendered view."""
        old, new, weight = self.seconds_per_pixel, seconds / pixels, EMA_WEIGHT * min(1.0, pixels / PROBE_PIXELS)
        self.seconds_per_pixel = new if old is None else (1 - weight) * old + weight * new
