"""Early stopping: when more training is no longer worth its time, judged by the held-out quality over time."""

import math

import numpy as np

MEASUREMENT_SPACING = 1.15
"""Each measurement comes when this factor more has been spent than at the one before."""
FIRST_MEASUREMENT = 0.01
"""Share of the budget spent at the first measurement."""
TREND_WINDOW = 2.0
"""The trend is taken over the measurements since this factor less was spent ..."""
MIN_MEASUREMENTS = 4
"""... if there are at least this many."""
EXTRA_TIME_FACTOR = 1.5


class PlateauDetector:
    """Held-out quality grows roughly with the logarithm of time: the slope says what more time would gain.

    Args:
        patience: dB that 50 % more time must still gain.
    """

    def __init__(self, patience: float):
        self.patience = patience
        self.state: tuple[list[tuple[float, float]], int] = ([], 0)
        """(fraction of the budget spent, dB) of each measurement, and how many in a row say that more are not worth it."""

    def is_due(self, spent: float) -> bool:
        """Whether it is time for another measurement."""
        points, _ = self.state
        return spent >= (points[-1][0] * MEASUREMENT_SPACING if points else FIRST_MEASUREMENT)

    def add_measurement(self, spent: float, psnr: float) -> bool:
        """Adds a measurement.

        Returns:
            Whether there is a plateau: two measurements in a row say so, as one may be luck.
        """
        points, flat_streak = self.state
        points.append((spent, psnr))
        gain = self.predict_gain(EXTRA_TIME_FACTOR)
        flat_streak = flat_streak + 1 if gain is not None and gain < self.patience else 0
        self.state = points, flat_streak
        return flat_streak >= 2

    def predict_gain(self, factor: float) -> float | None:
        """dB that `factor` times the time spent would gain by the present trend; None with too few measurements."""
        points, _ = self.state
        recent = [point for point in points if point[0] * TREND_WINDOW >= points[-1][0]]
        if len(recent) < MIN_MEASUREMENTS:
            return None
        spent, psnr = np.array(recent).T
        return float(np.polyfit(np.log(spent), psnr, 1)[0]) * math.log(factor)

    def reset_trend(self) -> None:
        """Forgets the trend, as training enters another stage."""
        self.state = self.state[0][-1:], 0
