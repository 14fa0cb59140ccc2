"""LossMonitor: judges from losses, gradients and opacities whether training works, is stuck, or diverges."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

EMA_DECAY = 0.96
"""Of the running mean of the loss: it looks back about 25 steps."""
LEARNED_RATIO = 0.85
"""A field whose error is above this share of that of one plain colour has not learned the scene."""
STALL_RATIO, SLOW_RATIO = 0.98, 0.9
"""An error above this share of what it was some steps ago has not fallen: below that of a plain colour, and above it."""
DIVERGED_RATIO, DIVERGED_CHECKS = 4.0, 3
"""Training diverges when the error is above this many times its lowest, at so many checks in a row ..."""
WORSE_RATIO, HALF_LEARNED_RATIO = 1.1, 0.3
"""... or stays above the first times its lowest while it is more than the second share of that of one plain colour."""
EMPTY_OPACITY, FULL_OPACITY = 1e-3, 0.999
"""Mean opacity of rays: below the first there is no density, above the second there is density everywhere."""


@dataclass(frozen=True)
class TrainingFailure:
    """Why training will not get better by itself."""

    cause: str
    diverged: bool
    """Whether training diverges; otherwise it is stuck."""


@dataclass
class LossHistory:
    """What a monitor has seen since training began, or began again; a checkpoint keeps it."""

    start_step: int = 0
    ema_loss: float | None = None
    """The loss, averaged over the last steps; not finite once a loss was not."""
    check_losses: list[float] = field(default_factory=list)
    """The same, at the checks within the last `patience` steps."""
    min_loss: float = math.inf
    num_dead_checks: int = 0
    """Checks in a row at which no gradient came back."""


class LossMonitor:
    """The running state of a training, judged at regular checks.

    Args:
        every: steps between checks.
        patience: steps within which the loss must fall below that of a plain colour, or at least fall.
        constant_color_loss: the loss of one plain colour.
    """

    def __init__(self, every: int, patience: int, constant_color_loss: float = 0.0):
        self.every = every
        self.patience = patience
        self.constant_color_loss = constant_color_loss
        self.history = LossHistory()

    def reset(self, start_step: int | None = None) -> None:
        """Forgets everything; with a step, training has started again there."""
        self.history = LossHistory(self.history.start_step if start_step is None else start_step)

    def is_due(self, step: int) -> bool:
        """Whether to check at this step."""
        return step % self.every == 0

    @property
    def has_learned(self) -> bool:
        """Whether the field has learned more than one plain colour."""
        loss = self.history.ema_loss
        return loss is not None and loss < LEARNED_RATIO * self.constant_color_loss

    @property
    def is_healthy(self) -> bool:
        """Whether the field has learned something, and is not losing it: its weights are worth keeping."""
        loss = self.history.ema_loss
        return self.has_learned and loss is not None and loss <= DIVERGED_RATIO * self.history.min_loss

    def add_loss(self, loss: float) -> None:
        """Adds a step's squared error."""
        mean = self.history.ema_loss
        self.history.ema_loss = loss if mean is None else EMA_DECAY * mean + (1 - EMA_DECAY) * loss

    def add_gradient(self, has_gradient: bool) -> None:
        """Adds whether any gradient came back, at a check before the field has begun to learn."""
        self.history.num_dead_checks = 0 if has_gradient else self.history.num_dead_checks + 1

    def check(self, step: int, opacity: float | None) -> TrainingFailure | None:
        """Judges training at a step; None if it may go on.

        Args:
            step: since the run began.
            opacity: mean of the step's rays; None for pictures.
        """
        history, loss = self.history, self.history.ema_loss
        if loss is None:
            return None
        window = self.patience // self.every + 2
        history.check_losses = [*history.check_losses, loss][-window:]
        is_window_full = len(history.check_losses) == window and step - history.start_step >= self.patience
        if cause := self._divergence_cause(loss, is_window_full):
            return TrainingFailure(cause, True)
        if cause := self._stall_cause(loss, is_window_full, opacity):
            return TrainingFailure(cause, False)
        history.min_loss = min(history.min_loss, loss)
        return None

    def _divergence_cause(self, loss: float, is_window_full: bool) -> str:
        """How what was learned is being lost; "" if it is not."""
        check_losses, min_loss = self.history.check_losses, self.history.min_loss
        recent = check_losses[-DIVERGED_CHECKS:]
        has_risen = len(recent) == DIVERGED_CHECKS and min(recent) > DIVERGED_RATIO * min_loss
        # A short spike, which falls again, does not matter.
        if min_loss < LEARNED_RATIO * self.constant_color_loss and has_risen and loss > STALL_RATIO * recent[0]:
            return f"the loss rose to {loss / min_loss:.0f} times its lowest"
        if is_window_full and min(check_losses[1:]) > max(
            WORSE_RATIO * min_loss, HALF_LEARNED_RATIO * self.constant_color_loss
        ):
            share = min_loss / self.constant_color_loss
            return f"the loss fell to {share:.2f} times that of one plain colour, and has stayed above that since"
        return ""

    def _stall_cause(self, loss: float, is_window_full: bool, opacity: float | None) -> str:
        """Why nothing is being learned; "" if something is, or training has only just begun."""
        if self.has_learned or not self.constant_color_loss:
            return ""  # a scene of one colour is learned as soon as its colour is
        check_losses = self.history.check_losses
        if self.history.num_dead_checks < 2:  # without a gradient, waiting does not help
            is_falling = all(after < before for before, after in pairwise(check_losses))
            enough = SLOW_RATIO if loss > self.constant_color_loss and not is_falling else STALL_RATIO
            if not is_window_full or loss < enough * check_losses[0]:
                return ""
        stuck = f"the loss stands at {loss / self.constant_color_loss:.2f} times that of one plain colour"
        if opacity is not None and opacity < EMPTY_OPACITY:
            return f"there is no density anywhere, so no gradient comes back; {stuck}"
        if self.history.num_dead_checks:
            return f"no gradient reaches any weight; {stuck}"
        if opacity is not None and opacity > FULL_OPACITY:
            return f"there is density everywhere, a wall before every camera; {stuck}"
        return stuck
