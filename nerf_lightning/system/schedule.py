"""Learning-rate factors as functions of progress, the fraction of the budget done, so that they fit any budget."""

import math


def _warm(progress: float, warmup: float) -> float:
    return min(1.0, (progress + 1e-3) / (warmup + 1e-3))


def constant(progress: float, warmup: float = 0.0) -> float:
    """1 after a linear warm-up over the first `warmup` of the budget."""
    return _warm(progress, warmup)


def exponential(progress: float, warmup: float = 0.01, final: float = 0.1) -> float:
    """Warm-up, then final^progress: from 1 down to `final` at the end."""
    return _warm(progress, warmup) * final**progress


def cosine(progress: float, warmup: float = 0.01, final: float = 0.0) -> float:
    """Warm-up, then half a cosine from 1 down to `final` at the end."""
    return _warm(progress, warmup) * (final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0))))
