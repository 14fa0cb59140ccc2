"""Plateau: when more training is no longer worth its time, judged by the held-out quality over time."""

import math
from typing import Any

import numpy as np

SPACING = 1.15
"""Each measurement comes when this factor more has been spent than at the one before."""
FIRST = 0.01
"""Share of the budget spent at the first measurement."""
LOOK_BACK = 2.0
"""The trend is taken over the measurements since this factor less was spent ..."""
FEWEST = 4
"""... if there are at least this many."""
HALF_AGAIN = 1.5


class Plateau:
    """Held-out quality grows roughly with the logarithm of time: the slope says what more time would gain.

    Args:
        patience: dB that 50 % more time must still gain.
    """

    def __init__(self, patience: float):
        self.patience = patience
        self.points: list[tuple[float, float]] = []
        """(fraction of the budget spent, dB)."""
        self.flat = 0
        """Measurements in a row after which 50 % more time would not be worth it."""

    def due(self, spent: float) -> bool:
        """Whether it is time for another measurement."""
        return spent >= (self.points[-1][0] * SPACING if self.points else FIRST)

    def note(self, spent: float, quality: float) -> bool:
        """Adds a measurement.

        Returns:
            Whether there is a plateau: two measurements in a row say so, as one may be luck.
        """
        self.points.append((spent, quality))
        gain = self.gain(HALF_AGAIN)
        self.flat = self.flat + 1 if gain is not None and gain < self.patience else 0
        return self.flat >= 2

    def gain(self, factor: float) -> float | None:
        """dB that `factor` times the time spent would gain by the present trend; None with too few measurements."""
        last = self.points[-1][0] if self.points else 0.0
        recent = [point for point in self.points if point[0] * LOOK_BACK >= last]
        if len(recent) < FEWEST:
            return None
        spent, quality = np.array(recent).T
        return float(np.polyfit(np.log(spent), quality, 1)[0]) * math.log(factor)

    def start(self) -> None:
        """Forgets the trend, as training enters another stage."""
        self.points = self.points[-1:]
        self.flat = 0

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"points": [list(point) for point in self.points], "flat": self.flat}

    def load(self, state: dict[str, Any]) -> None:
        """Restores what `state` returned."""
        self.points = [(spent, quality) for spent, quality in state["points"]]
        self.flat = state["flat"]
        if any(spent <= 0 for spent, _ in self.points):
            raise ValueError("a plateau's measurement before training")
