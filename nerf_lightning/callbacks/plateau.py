"""Plateau: when more training is no longer worth its time, told from held-out quality against what was spent."""

import math
from typing import Any

import numpy as np

SPACING = 1.15
"""Factor between what was spent at one measurement and the next."""
FIRST = 0.01
"""Fraction of the budget spent at the first one."""
LOOK_BACK = 2.0
"""The trend is that of the measurements since this factor less was spent ..."""
FEWEST = 4
"""... at least so many."""
HALF_AGAIN = 1.5


class Plateau:
    """Held-out quality grows with the logarithm of time, ever more slowly: its slope says what more time would bring.

    Args:
        patience: dB that half as much time again must bring.
    """

    def __init__(self, patience: float):
        self.patience = patience
        self.points: list[tuple[float, float]] = []
        """(fraction of the budget spent, dB)."""
        self.flat = 0
        """Measurements in a row by which half as much time again would not be worth it."""

    def due(self, spent: float) -> bool:
        """Whether it is time for another measurement."""
        return spent >= (self.points[-1][0] * SPACING if self.points else FIRST)

    def note(self, spent: float, quality: float) -> bool:
        """Takes in a measurement.

        Returns:
            Whether a plateau is reached: two measurements in a row say so, as one may be chance.
        """
        self.points.append((spent, quality))
        gain = self.gain(HALF_AGAIN)
        self.flat = self.flat + 1 if gain is not None and gain < self.patience else 0
        return self.flat >= 2

    def gain(self, factor: float) -> float | None:
        """dB that `factor` times what was spent would add, by the present trend; None where too little was measured."""
        last = self.points[-1][0] if self.points else 0.0
        recent = [point for point in self.points if point[0] * LOOK_BACK >= last]
        if len(recent) < FEWEST:
            return None
        spent, quality = np.array(recent).T
        return float(np.polyfit(np.log(spent), quality, 1)[0]) * math.log(factor)

    def start(self) -> None:
        """Forgets the trend: training has entered another stage."""
        self.points = self.points[-1:]
        self.flat = 0

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"points": [list(point) for point in self.points], "flat": self.flat}

    def load(self, state: dict[str, Any]) -> None:
        """Takes up what `state` gave."""
        self.points = [(spent, quality) for spent, quality in state["points"]]
        self.flat = state["flat"]
