"""Rendering beside training: it takes no longer than training does, and its end can be told."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TypeVar

MIN_RENDER_SECONDS = 30.0
"""Rendering may always take this long, however short the training is."""
MIN_RENDER_FRACTION = 0.01
"""Of its pixels, that each job renders however little time there is."""
EMA_WEIGHT = 0.7
"""Weight of the last view in the seconds that a pixel takes."""
PROBE_PIXELS = 1 << 14
"""Pixels whose time tells what others take; fewer count less."""
Job = TypeVar("Job")


def allocate_max_min_fair(
    costs: Mapping[Job, float], weights: Mapping[Job, float], allowance: float
) -> dict[Job, float]:
    """Weighted max-min fair shares: no job gets more than it costs, and what it leaves is divided among the others.

    Args:
        costs, weights: seconds of each job, and its weight.
        allowance: seconds for all of them; each gets `MIN_RENDER_FRACTION` of its own in any case.
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
    """Counts the time of rendering, measures what a pixel takes, and says what is being rendered."""

    def __init__(self) -> None:
        self.seconds = 0.0
        """Seconds of rendering so far."""
        self.seconds_per_pixel: float | None = None
        """Of rendering; None before the first view."""
        self.subject = ""
        """What is being rendered."""
        self._listener: Callable[[], None] = lambda: None

    def subscribe(self, listener: Callable[[], None]) -> None:
        """Calls it whenever something else is being rendered."""
        self._listener = listener

    @contextmanager
    def measure(self, subject: str) -> Iterator[None]:
        """Counts the time of a block as rendering."""
        self.start(subject)
        try:
            yield
        finally:
            self.stop()

    def start(self, subject: str) -> None:
        """The same where the block is not one."""
        self.subject, self._since = subject, time.perf_counter()
        self._listener()

    def stop(self) -> None:
        self.seconds += time.perf_counter() - self._since
        self.subject = ""

    def add_timing(self, pixels: int, seconds: float) -> None:
        """Called with the time that a view took."""
        each, weight = seconds / pixels, EMA_WEIGHT * min(1.0, pixels / PROBE_PIXELS)
        self.seconds_per_pixel = (
            each if self.seconds_per_pixel is None else (1 - weight) * self.seconds_per_pixel + weight * each
        )
