"""What there is to choose from, and decisions on figures alone: when to stop growing, what to train in full, what is enough."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nerf_lightning.config import conf_dir
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import expand_user_path
from nerf_lightning.utils.parsing import read_yaml

Options = dict[str, Any]
GAIN_DIVISOR = 3.0
"""A rung pays where it gains a `GAIN_DIVISOR`th of what the choice may be below the best, for twice the bytes."""
MAX_RUNGS_WITHOUT_GAIN = 2
"""Rungs in a row that are not worth their bytes, after which growing stops: one may be chance."""
FULL_TRAINING_GAIN_DB = 1.0
"""What a full training is assumed to gain over a rung's shorter one: 2 to 15 were measured, in runs of 10 to 140 s."""
TOLERANCE_DB = 0.5
"""By which an expectation may be wrong."""


@dataclass(frozen=True)
class Ladder:
    """What there is to choose from."""

    rungs: list[Options]
    """Options of the model, smallest first."""
    samplers: list[Options]
    """Options of the sampler, coarsest first; none for images."""


def read_ladder(name: str) -> Ladder:
    """Reads a ladder: one of conf/ladders by name, or a YAML file of one's own.

    Raises:
        InputError: where there is none of that name, or it holds something else.
    """
    known = sorted(file.stem for file in (conf_dir() / "ladders").glob("*.yaml"))
    path = conf_dir() / "ladders" / f"{name}.yaml" if name in known else expand_user_path(name)
    if not path.is_file():
        raise InputError("rightsize", "ladder", name, f"one of {', '.join(known)}, or a YAML file with `rungs`")
    content = read_yaml(path, "a ladder in YAML")
    lists = content if isinstance(content, dict) else {}
    for key, least in (("rungs", 2), ("samplers", 0)):
        found = lists.setdefault(key, [])
        if not isinstance(found, list) or len(found) < least or not all(isinstance(one, dict) for one in found):
            raise InputError(path, key, repr(found), f"a list of {least} or more mappings of options")
    return Ladder(lists["rungs"], lists["samplers"])


@dataclass(frozen=True)
class Target:
    """What is good enough: a figure, or without one a distance from the best that can be reached."""

    psnr: float | None = None
    within_db: float = 0.3


@dataclass(frozen=True)
class RungResult:
    """A trained rung: how good it is, and how large."""

    psnr: float
    """Held-out dB."""
    size: int
    """Bytes of the compact file."""
    parameters: int = 0
    seconds: float = 0.0
    """Of training."""


def is_growth_finished(rungs: Sequence[RungResult], target: Target) -> bool:
    """Whether there is no point in growing further: the target is near, or the last rungs gained less than they cost."""
    if target.psnr is not None:
        return rungs[-1].psnr >= target.psnr - FULL_TRAINING_GAIN_DB
    if len(rungs) <= MAX_RUNGS_WITHOUT_GAIN:
        return False
    # The best before counts, not the last: two rungs that fall and rise again have gained nothing.
    base = max(rungs[:-MAX_RUNGS_WITHOUT_GAIN], key=lambda one: one.psnr)
    each = target.within_db / GAIN_DIVISOR
    return all(
        one.psnr - base.psnr <= each * max(math.log2(one.size / base.size), 1.0)
        for one in rungs[-MAX_RUNGS_WITHOUT_GAIN:]
    )


def find_best(rungs: Sequence[RungResult]) -> int:
    """The rung with the highest PSNR, the smallest of equals."""
    return max(range(len(rungs)), key=lambda rung: rungs[rung].psnr)


def choose_candidate(rungs: Sequence[RungResult], target: Target) -> int:
    """The rung to train in full first: the smallest that seems good enough, or the best where none does."""
    best = find_best(rungs)
    enough = rungs[best].psnr - target.within_db if target.psnr is None else target.psnr - FULL_TRAINING_GAIN_DB
    return next((rung for rung, one in enumerate(rungs) if one.psnr >= enough), best)


def choose_neighbour(first: int, psnr: float, rungs: Sequence[RungResult], target: Target, last: int) -> int | None:
    """The rung to train in full beside the first, to be sure of the choice; None where that is sure.

    Args:
        first: see `choose_candidate`.
        psnr: dB that it reaches trained in full.
        rungs: as they were while growing.
        last: the largest rung of the ladder.
    """
    if target.psnr is None:
        best = find_best(rungs)
        return None if best == first else best
    if psnr < target.psnr:
        return first + 1 if first < last else None
    needed = rungs[first].psnr + target.psnr - psnr
    likely = (rung for rung in range(first) if rungs[rung].psnr >= needed - (TOLERANCE_DB if rung == first - 1 else 0))
    return next(likely, None)


def choose_final(full: Mapping[int, RungResult], target: Target) -> tuple[int, bool]:
    """The smallest of the rungs trained in full that is good enough, or the best; and whether it is good enough."""
    best = max(full, key=lambda rung: full[rung].psnr)
    enough = full[best].psnr - target.within_db if target.psnr is None else target.psnr
    found = [rung for rung, one in full.items() if one.psnr >= enough]
    return (min(found), True) if found else (best, False)
