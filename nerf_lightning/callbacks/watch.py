"""Watch: judges from losses, gradients and opacities whether training works, is stuck, or diverges."""

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

MEMORY = 0.96
"""Decay of the running mean of the loss: it looks back about 25 steps."""
AS_PLAIN = 0.85
"""A field whose error is above this share of that of one plain colour has not learned the scene."""
STANDING, HARDLY_FALLING = 0.98, 0.9
"""An error above this share of what it was some steps ago has not fallen: below that of a plain colour, and above it."""
RISEN, WORSE = 4.0, 1.1
"""Training diverges when the error is above the first times its lowest, or stays above the second ..."""
HALF_LEARNED = 0.3
"""... while it is more than this share of that of one plain colour."""
EMPTY, FULL = 1e-3, 0.999
"""Mean opacity of rays: below the first there is no density, above the second there is density everywhere."""


@dataclass(frozen=True)
class Breakdown:
    """Why training will not get better by itself."""

    cause: str
    apart: bool
    """Whether training diverges; otherwise it is stuck."""


class Watch:
    """The running state of a training, judged at regular looks.

    Args:
        every: steps between looks.
        patience: steps within which the loss must fall below that of a plain colour, or at least fall.
        plain: the loss of one plain colour.
    """

    def __init__(self, every: int, patience: int, plain: float = 0.0):
        self.every = every
        self.patience = patience
        self.plain = plain
        self.start(0)

    def start(self, step: int | None = None) -> None:
        """Forgets everything; with a step, training has started again there."""
        if step is not None:
            self.began = step
        self.level: float | None = None
        """The loss, averaged over the last steps."""
        self.earlier: list[float] = []
        """The same, at the looks within the last `patience` steps."""
        self.lowest = math.inf
        self.risen = 0
        """Looks in a row at which the loss was far above its lowest."""
        self.dead = 0
        """Looks in a row at which no gradient came back."""

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {key: getattr(self, key) for key in ("began", "level", "earlier", "lowest", "risen", "dead")}

    def load(self, state: dict[str, Any]) -> None:
        """Restores what `state` returned."""
        self.began, self.risen, self.dead = (state[key] for key in ("began", "risen", "dead"))
        self.level = state["level"]
        self.earlier, self.lowest = list(state["earlier"]), state["lowest"]

    def due(self, step: int) -> bool:
        """Whether to look at this step."""
        return step % self.every == 0

    @property
    def learning(self) -> bool:
        """Whether the field has learned more than one plain colour."""
        return self.level is not None and self.level < AS_PLAIN * self.plain

    def note(self, error: float) -> None:
        """Adds a step's squared error."""
        self.level = error if self.level is None else MEMORY * self.level + (1 - MEMORY) * error

    def note_gradient(self, alive: bool) -> None:
        """Adds whether any gradient came back, at a look before the field has begun to learn."""
        self.dead = 0 if alive else self.dead + 1

    def look(self, step: int, opacity: float | None) -> Breakdown | None:
        """Judges training at a step; None if it may go on.

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
        """Whether there have been enough looks to judge by."""
        return step - self.began >= self.patience and len(self.earlier) > self.patience // self.every

    def _coming_apart(self, step: int, level: float) -> str:
        """How what was learned is being lost; "" if it is not."""
        risen = self.lowest < AS_PLAIN * self.plain and level > RISEN * self.lowest
        # A short spike does not matter.
        stays = bool(self.earlier) and level > STANDING * self.earlier[-1]
        self.risen = self.risen + 1 if risen and stays else 0
        if self.risen >= 3:
            return f"the loss rose to {level / self.lowest:.0f} times its lowest"
        least = min([*self.earlier[1:], level])
        if self._waited(step) and least > max(WORSE * self.lowest, HALF_LEARNED * self.plain):
            lowest = self.lowest / self.plain
            return f"the loss fell to {lowest:.2f} times that of one plain colour, and has stayed above that since"
        return ""

    def _stuck(self, step: int, level: float, opacity: float | None) -> str:
        """Why nothing is being learned; "" if something is, or training has only just begun."""
        if self.learning or not self.plain:
            return ""  # a scene of one colour is learned as soon as its colour is
        if self.dead < 2:  # without a gradient, waiting does not help
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
