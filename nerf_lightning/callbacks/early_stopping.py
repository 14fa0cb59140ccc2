"""Early stopping: predicts from held-out PSNR over time what more training would gain."""

import math

import numpy as np

MEASUREMENT_SPACING = 1.15
"""Ratio of the budget spent between consecutive measurements."""
FIRST_MEASUREMENT = 0.01
"""Fraction of the budget spent at the first measurement."""
TREND_WINDOW = 2.0
"""Ratio of the budget spent over which the trend is fitted ..."""
MIN_MEASUREMENTS = 4
"""... if it holds at least this many measurements."""
EXTRA_TIME_FACTOR = 1.5


class PlateauDetector:
    """Fits held-out PSNR over log time: the slope predicts the gain of more time.

    Args:
        patience: dB that 50 % more time must still gain.
    """

    def __init__(self, patience: float):
        self.patience = patience
        self.state: tuple[list[tuple[float, float]], int] = ([], 0)
        """(fraction of the budget spent, dB) of each measurement, and the number of consecutive ones at a plateau."""

    def is_due(self, spent: float) -> bool:
        points, _ = self.state
        return spent >= (points[-1][0] * MEASUREMENT_SPACING if points else FIRST_MEASUREMENT)

    def add_measurement(self, spent: float, psnr: float) -> bool:
        """Adds a measurement. Returns whether there is a plateau: two in a row, as one may be noise."""
        points, flat_streak = self.state
        points.append((spent, psnr))
        gain = self.predict_gain(EXTRA_TIME_FACTOR)
        flat_streak = flat_streak + 1 if gain is not None and gain < self.patience else 0
        self.state = points, flat_streak
        return flat_streak >= 2

    def predict_gain(self, factor: float) -> float | None:
        """Predicted gain in dB of `factor` times the time spent; None with too few measurements."""
        points, _ = self.state
        recent = [point for point in points if point[0] * TREND_WINDOW >= points[-1][0]]
        if len(recent) < MIN_MEASUREMENTS:
            return None
        spent, psnr = np.array(recent).T
        return float(np.polyfit(np.log(spent), psnr, 1)[0]) * math.log(factor)

    def reset_trend(self) -> None:
        """Discards the trend, as the field enters another growth stage."""
        self.state = self.state[0][-1:], 0
