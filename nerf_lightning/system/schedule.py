"""Learning-rate factors as functions of progress, the part of the budget done, so that they fit any budget, and of the step."""

import math

from nerf_lightning.utils.options import Count


def _start(progress: float, step: int, warmup: float, inverse_root: Count | None) -> float:
    """The factor that all have in common: a linear warm-up, and 1 / sqrt(1 + step / inverse_root)."""
    warm = min(1.0, (progress + 1e-3) / (warmup + 1e-3))
    return warm if inverse_root is None else warm / math.sqrt(1 + step / inverse_root)


def constant(progress: float, step: int = 0, warmup: float = 0.0, inverse_root: Count | None = None) -> float:
    """1 after a linear warm-up over the first `warmup` of the budget; besides, as one over the root of steps, if many of these
    are to be taken: from `inverse_root` steps on. A long training at the rate of a short one loses what it has."""
    return _start(progress, step, warmup, inverse_root)


def exponential(
    progress: float, step: int = 0, warmup: float = 0.01, final: float = 0.1, inverse_root: Count | None = None
) -> float:
    """As `constant`, times final^progress: from 1 down to `final` at the end."""
    return _start(progress, step, warmup, inverse_root) * final**progress


def cosine(
    progress: float, step: int = 0, warmup: float = 0.01, final: float = 0.0, inverse_root: Count | None = None
) -> float:
    """As `constant`, times half a cosine from 1 down to `final` at the end."""
    fallen = final + (1 - final) * 0.5 * (1 + math.cos(math.pi * min(progress, 1.0)))
    return _start(progress, step, warmup, inverse_root) * fallen
