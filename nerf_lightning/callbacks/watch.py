"""Watch: tells from losses, gradients and opacities whether training goes on, is stuck, or comes apart."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

MEMORY = 0.96
"""Of the running mean of the loss, a step: it looks back about 25 steps."""
AS_PLAIN = 0.85
"""Share of the error of one plain colour above which a field has not learned the scene."""
STANDING, HARDLY_FALLING = 0.98, 0.9
"""Shares of the error some steps ago above which it has not fallen since: below that of a plain colour, and above it."""
RISEN, WORSE = 4.0, 1.1
"""Times the lowest error seen, above which training is coming apart; and above which it must not stay ..."""
HALF_LEARNED = 0.3
"""... while the error is more than this share of that of one plain colour."""
EMPTY, FULL = 1e-3, 0.999
"""Mean opacity of rays below which there is no density, and above which there is nothing but density."""


@dataclass(frozen=True)
class Breakdown:
    """Why training will not get better by itself."""

    cause: str
    apart: bool
    """Whether it moves too fast to keep what it learns; otherwise it does not move at all."""


class Watch:
    """The running state of a training, judged at regular looks.

    Args:
        every: steps between looks.
        patience: steps in which the loss must fall below that of a plain colour, or at least fall.
        plain: the loss of one plain colour.
    """

    def __init__(self, every: int, patience: int, plain: float = 0.0):
        self.every = every
        self.patience = patience
        self.plain = plain
        self.start(0)

    def start(self, step: int | None = None) -> None:
        """Forgets what it saw; with a step, training has started anew there."""
        if step is not None:
            self.began = step
        self.level: float | None = None
        """The loss, averaged over the last steps."""
        self.earlier: list[float] = []
        """The same at the looks of the last `patience` steps."""
        self.lowest = math.inf
        self.risen = 0
        """Looks in a row at which the loss was far above its lowest."""
        self.dead = 0
        """Looks in a row at which no gradient came back."""

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {key: getattr(self, key) for key in ("began", "level", "earlier", "lowest", "risen", "dead")}

    def load(self, state: dict[str, Any]) -> None:
        """Takes up what `state` gave."""
        for key in self.state():
            setattr(self, key, state[key])

    def due(self, step: int) -> bool:
        """Whether there is a look at a step."""
        return step % self.every == 0

    @property
    def learning(self) -> bool:
        """Whether the field has learned more than one plain colour."""
        return self.level is not None and self.level < AS_PLAIN * self.plain

    def note(self, error: float) -> None:
        """Takes in a step's squared error."""
        self.level = error if self.level is None else MEMORY * self.level + (1 - MEMORY) * error

    def note_gradient(self, alive: bool) -> None:
        """Takes in whether any gradient came back, at a look before the field has begun to learn."""
        self.dead = 0 if alive else self.dead + 1

    def look(self, step: int, opacity: float | None) -> Breakdown | None:
        """Judges training at a step; None where it may go on.

        Args:
            step: since the run began.
            opacity: mean of the step's rays; None for pictures.
        """
        level = self.level
        if level is None:
            return None
        apart = self._coming_apart(step, level)
        cause = apart or self._stuck(step, level, opacity)
        if cause:
            return Breakdown(cause, bool(apart))
        self.earlier = [*self.earlier, level][-(self.patience // self.every + 1) :]
        self.lowest = min(self.lowest, level)
        return None

    def _waited(self, step: int) -> bool:
        """Whether there were looks enough to judge by."""
        return step - self.began >= self.patience and len(self.earlier) > self.patience // self.every

    def _coming_apart(self, step: int, level: float) -> str:
        """How what was learned is being lost; "" where it is not."""
        risen = self.lowest < AS_PLAIN * self.plain and level > RISEN * self.lowest
        # A spike that passes is none of its business.
        stays = bool(self.earlier) and level > STANDING * self.earlier[-1]
        self.risen = self.risen + 1 if risen and stays else 0
        if self.risen >= 3:
            return f"the loss rose to {level / self.lowest:.0f} times its lowest"
        least = min([*self.earlier[1:], level])
        if self._waited(step) and least > max(WORSE * self.lowest, HALF_LEARNED * self.plain):
            return f"the loss fell to {self.lowest / self.plain:.2f} times that of one plain colour, and stays above that since"
        return ""

    def _stuck(self, step: int, level: float, opacity: float | None) -> str:
        """Why nothing is being learned; "" where something is, or was only just begun."""
        if self.learning or not self.plain:
            return ""  # a scene of one colour is learned as soon as its colour is
        if self.dead < 2:  # without a gradient there is nothing to wait for
            if not self._waited(step):
                return ""
            falling = all(after < before for before, after in pairwise([*self.earlier, level]))
            enough = HARDLY_FALLING if level > self.plain and not falling else STANDING
            if level < enough * self.earlier[0]:
                return ""
        stuck = f"the loss stands at {level / self.plain:.2f} times that of one plain colour"
        if opacity is not None and opacity < EMPTY:
            return f"there is no density anywhere, so no gradient comes back; {stuck}"
        if self.dead:
            return f"no gradient reaches any weight; {stuck}"
        if opacity is not None and opacity > FULL:
            return f"there is density everywhere, a wall before every camera; {stuck}"
        return stuck
