"""Plateau: when more training is no longer worth its time, judged by the held-out quality over time."""

import math

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
        self.state: tuple[list[tuple[float, float]], int] = ([], 0)
        """(fraction of the budget spent, dB) of each measurement, and how many in a row say that more are not worth it."""

    def due(self, spent: float) -> bool:
        """Whether it is time for another measurement."""
        points, _ = self.state
        return spent >= (points[-1][0] * SPACING if points else FIRST)

    def note(self, spent: float, quality: float) -> bool:
        """Adds a measurement.

        Returns:
            Whether there is a plateau: two measurements in a row say so, as one may be luck.
        """
        points, flat = self.state
        points.append((spent, quality))
        gain = self.gain(HALF_AGAIN)
        flat = flat + 1 if gain is not None and gain < self.patience else 0
        self.state = points, flat
        return flat >= 2

    def gain(self, factor: float) -> float | None:
        """dB that `factor` times the time spent would gain by the present trend; None with too few measurements."""
        points, _ = self.state
        recent = [point for point in points if point[0] * LOOK_BACK >= points[-1][0]]
        if len(recent) < FEWEST:
            return None
        spent, quality = np.array(recent).T
        return float(np.polyfit(np.log(spent), quality, 1)[0]) * math.log(factor)

    def start(self) -> None:
        """Forgets the trend, as training enters another stage."""
        self.state = self.state[0][-1:], 0
