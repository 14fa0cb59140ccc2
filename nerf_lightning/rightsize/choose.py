"""When to stop climbing, and which rung is enough: decisions on figures alone."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nerf_lightning.errors import InputError

SHARE = 3.0
"""A rung is worth climbing to where it gains a `SHARE`th of what the choice may be below the best, for twice the bytes."""
IDLE = 2
"""Rungs in a row that are not worth it, after which climbing stops: one may be random."""

MORE = 1.0
"""dB that a full training is assumed to gain over the climb's shorter one: 2 to 15 were measured, in runs of 10 to 140 s."""
CLOSE = 0.5
"""dB that an expectation may be wrong by."""


@dataclass(frozen=True)
class Target:
    """What is good enough: a figure, or a distance from the best that can be reached. Exactly one of the two."""

    psnr: float | None = None
    within_db: float | None = None

    def __post_init__(self) -> None:
        if (self.psnr is None) == (self.within_db is None):
            raise InputError("config", "target", f"psnr={self.psnr} and within_db={self.within_db}", "one of the two")
        if self.within_db is not None and not self.within_db >= 0:
            raise InputError("config", "target.within_db", str(self.within_db), "at least 0")


@dataclass(frozen=True)
class Measured:
    """How good a rung is, and how large."""

    psnr: float
    """dB held out."""
    size: int
    """Bytes of the compact file."""


def worth(before: Measured, after: Measured, slack: float, noise: float) -> bool:
    """Whether the step from one rung to the next gains enough for its bytes, and more than seeds differ.

    Args:
        slack: dB that the choice may be below the best.
        noise: dB by which seeds differ.
    """
    doublings = max(math.log2(after.size / before.size), 1.0)
    return after.psnr - before.psnr > max(noise, slack / SHARE * doublings)


def climbed_enough(rungs: Sequence[Measured], target: Target, noise: float) -> str:
    """Why there is no point in climbing further; "" where there is one."""
    if target.psnr is not None:
        return "the target is near" if rungs[-1].psnr >= target.psnr - MORE else ""
    assert target.within_db is not None  # exactly one of the two
    if len(rungs) <= IDLE:
        return ""
    # The best before counts, not the last: two rungs that fall and rise again have gained nothing.
    base = max(rungs[:-IDLE], key=lambda one: one.psnr)
    if any(worth(base, one, target.within_db, noise) for one in rungs[-IDLE:]):
        return ""
    return f"the last {IDLE} rungs gained less than they cost"


def candidate(rungs: Sequence[Measured], target: Target) -> int:
    """The smallest rung that seems good enough; the best one where none does."""
    best = max(one.psnr for one in rungs)
    enough = target.psnr - MORE if target.psnr is not None else best - (target.within_db or 0.0)
    return next((index for index, one in enumerate(rungs) if one.psnr >= enough), best_of(rungs))


def best_of(rungs: Sequence[Measured]) -> int:
    """The rung with the highest PSNR, the smallest of equals."""
    return max(range(len(rungs)), key=lambda index: rungs[index].psnr)


def knee(rungs: Sequence[Measured]) -> int:
    """Where more bytes begin to bring less: the rung farthest above the line from the smallest to the best one, dB over the
    logarithm of bytes, each from 0 to 1 (Satopaa et al. 2011)."""
    first, best = rungs[0], rungs[best_of(rungs)]
    bytes_up, gain = math.log(best.size / first.size), best.psnr - first.psnr
    if not bytes_up > 0 or not gain > 0:
        return 0

    def above(index: int) -> float:
        one = rungs[index]
        return (one.psnr - first.psnr) / gain - math.log(one.size / first.size) / bytes_up

    return max(range(len(rungs)), key=above)


def expected(index: int, tried: dict[int, float], rungs: Sequence[Measured]) -> float:
    """dB that a rung would reach trained in full: as much more than while growing as the nearest one that was.

    Args:
        tried: dB by rung of those trained in full, one at least of those climbed to.
    """
    near = min((one for one in tried if one < len(rungs)), key=lambda one: abs(one - index))
    return rungs[index].psnr + tried[near] - rungs[near].psnr


def next_to_train(
    tried: dict[int, float], rungs: Sequence[Measured], target: Target, last: int, most: int
) -> int | None:
    """Which rung to train in full next, to be sure of the choice; None where it is sure, or `most` are trained.

    Args:
        tried: dB by rung of those trained in full.
        rungs: those climbed to.
        target: see `Target`.
        last: the highest rung there is.
        most: trainings there may be.
    """
    first, best = candidate(rungs, target), best_of(rungs)
    if first not in tried:
        return first
    if len(tried) >= most:
        return None
    if target.psnr is None:
        wanted = [best, *range(first + 1, best)]
        return (
            next((rung for rung in wanted if rung not in tried), None) if chosen(tried, best, target) != first else None
        )
    met = [rung for rung, psnr in tried.items() if psnr >= target.psnr]
    if not met:
        return max(tried) + 1 if max(tried) < last else None
    failed = max((rung for rung in tried if rung < min(met)), default=-1)
    smaller = range(failed + 1, min(min(met), len(rungs)))
    # The first whole training tells how much more it brings than the climb: several rungs may turn out to be needless.
    likely = [rung for rung in smaller if expected(rung, tried, rungs) >= target.psnr]
    close = [rung for rung in smaller[-1:] if expected(rung, tried, rungs) >= target.psnr - CLOSE]
    return next(iter(likely + close), None)


def chosen(tried: dict[int, float], best: int, target: Target) -> int | None:
    """The smallest rung that full trainings have shown to be good enough; None where none was."""
    if target.psnr is not None:
        enough = target.psnr
    elif best not in tried:
        return None
    else:
        enough = max(tried.values()) - (target.within_db or 0.0)
    return min((rung for rung, psnr in tried.items() if psnr >= enough), default=None)
