"""Learning-rate factors as functions of training progress, so that they fit any budget, and of the step."""

import math

from nerf_lightning.utils.option_checks import Count


def _warmup_factor(progress: float, step: int, warmup: float, inverse_sqrt_after: Count | None) -> float:
    """Linear warm-up, times 1 / sqrt(1 + step / inverse_sqrt_after)."""
    factor = min(1.0, (progress + 1e-3) / (warmup + 1e-3))
    return factor if inverse_sqrt_after is None else factor / math.sqrt(1 + step / inverse_sqrt_after)


def constant(progress: float, step: int = 0, warmup: float = 0.0, inverse_sqrt_after: Count | None = None) -> float:
    """Constant factor 1 after a linear warm-up over the first `warmup` of the budget.

    All schedules: with `inverse_sqrt_after`, times 1 / sqrt(1 + step / inverse_sqrt_after), as a long training at the
    learning rate of a short one loses quality.
    """
    return _warmup_factor(progress, step, warmup, inverse_sqrt_after)


def exponential(
    progress: float,
    step: int = 0,
    warmup: float = 0.01,
    final_factor: float = 0.1,
    inverse_sqrt_after: Count | None = None,
) -> float:
    """Exponential decay from 1 to `final_factor`, times `constant` (warm-up)."""
    return _warmup_factor(progress, step, warmup, inverse_sqrt_after) * final_factor**progress


def cosine(
    progress: float,
    step: int = 0,
    warmup: float = 0.01,
    final_factor: float = 0.0,
    inverse_sqrt_after: Count | None = None,
) -> float:
    """Cosine decay from 1 to `final_factor`, times `constant` (warm-up)."""
    factor = final_factor + (1 - final_factor) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
    return _warmup_factor(progress, step, warmup, inverse_sqrt_after) * factor
