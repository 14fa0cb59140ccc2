"""Loss monitor: judges from losses, gradients and opacity whether training works, stalls or diverges."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

EMA_DECAY = 0.96
"""Decay of the loss's running mean: about 25 steps."""
LEARNED_RATIO = 0.85
"""A field has learned the scene once its loss is below this multiple of the constant-color loss."""
STALL_RATIO, SLOW_RATIO = 0.98, 0.9
"""Stalled: loss / earlier loss is above this, if below the constant-color loss, and if above it."""
DIVERGED_RATIO, DIVERGED_CHECKS = 4.0, 3
"""Diverged: the loss is above this multiple of its minimum, at this many consecutive checks ..."""
WORSE_RATIO, HALF_LEARNED_RATIO = 1.1, 0.3
"""... or stays above the first multiple of its minimum and the second of the constant-color loss."""
EMPTY_OPACITY, FULL_OPACITY = 1e-3, 0.999
"""Mean ray opacity below which there is no density, and above which it is everywhere."""


@dataclass(frozen=True)
class TrainingFailure:
    """Diagnosis of training that will not recover by itself."""

    cause: str
    diverged: bool
    """True if training diverges, False if it stalls."""


@dataclass
class LossHistory:
    """Loss history since training started or restarted; a checkpoint keeps it."""

    start_step: int = 0
    ema_loss: float | None = None
    """Running mean of the loss; not finite once a loss was not."""
    check_losses: list[float] = field(default_factory=list)
    """Running means at the checks within the last `patience` steps."""
    min_loss: float = math.inf
    num_dead_checks: int = 0
    """Consecutive checks without a gradient."""


class LossMonitor:
    """Judges training at regular checks.

    Args:
        every: steps between checks.
        patience: steps within which the loss must fall below that of a constant color, or at least fall.
        constant_color_loss: the loss of a constant color.
    """

    def __init__(self, every: int, patience: int, constant_color_loss: float = 0.0):
        self.every = every
        self.patience = patience
        self.constant_color_loss = constant_color_loss
        self.history = LossHistory()

    def reset(self, start_step: int | None = None) -> None:
        """Clears the history; with a step, training restarts there."""
        self.history = LossHistory(self.history.start_step if start_step is None else start_step)

    def is_due(self, step: int) -> bool:
        return step % self.every == 0

    @property
    def has_learned(self) -> bool:
        """Whether the field has learned more than a constant color."""
        loss = self.history.ema_loss
        return loss is not None and loss < LEARNED_RATIO * self.constant_color_loss

    @property
    def is_healthy(self) -> bool:
        """Whether the field has learned something and is not losing it, so that its weights are worth keeping."""
        loss = self.history.ema_loss
        return self.has_learned and loss is not None and loss <= DIVERGED_RATIO * self.history.min_loss

    def add_loss(self, loss: float) -> None:
        mean = self.history.ema_loss
        self.history.ema_loss = loss if mean is None else EMA_DECAY * mean + (1 - EMA_DECAY) * loss

    def add_gradient(self, has_gradient: bool) -> None:
        """Records at a check whether there was any gradient, before the field has begun to learn."""
        self.history.num_dead_checks = 0 if has_gradient else self.history.num_dead_checks + 1

    def check(self, step: int, opacity: float | None) -> TrainingFailure | None:
        """Checks training at a step; None if it may continue.

        Args:
            step: since the run began.
            opacity: mean over the step's rays; None for pictures.
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
        """Describes a divergence; "" if there is none."""
        check_losses, min_loss = self.history.check_losses, self.history.min_loss
        recent = check_losses[-DIVERGED_CHECKS:]
        has_risen = len(recent) == DIVERGED_CHECKS and min(recent) > DIVERGED_RATIO * min_loss
        # A short spike, which falls again, does not matter.
        if min_loss < LEARNED_RATIO * self.constant_color_loss and has_risen and loss > STALL_RATIO * recent[0]:
            return f"the loss rose to {loss / min_loss:.0f} times its lowest"
        limit = max(WORSE_RATIO * min_loss, HALF_LEARNED_RATIO * self.constant_color_loss)
        if is_window_full and min(check_losses[1:]) > limit:
            ratio = min_loss / self.constant_color_loss
            return f"the loss fell to {ratio:.2f} times that of a constant color, and has stayed above that since"
        return ""

    def _stall_cause(self, loss: float, is_window_full: bool, opacity: float | None) -> str:
        """Describes a stall; "" if the field learns, or training has only just begun."""
        if self.has_learned or not self.constant_color_loss:
            return ""  # a scene of one color needs nothing else
        check_losses = self.history.check_losses
        if self.history.num_dead_checks < 2:  # without a gradient, waiting does not help
            is_falling = all(after < before for before, after in pairwise(check_losses))
            max_ratio = SLOW_RATIO if loss > self.constant_color_loss and not is_falling else STALL_RATIO
            if not is_window_full or loss < max_ratio * check_losses[0]:
                return ""
        stuck = f"the loss is stuck at {loss / self.constant_color_loss:.2f} times that of a constant color"
        if opacity is not None and opacity < EMPTY_OPACITY:
            return f"there is no density anywhere, so no gradient comes back; {stuck}"
        if self.history.num_dead_checks:
            return f"no gradient reaches any weight; {stuck}"
        if opacity is not None and opacity > FULL_OPACITY:
            return f"there is density everywhere, a wall in front of every camera; {stuck}"
        return stuck
