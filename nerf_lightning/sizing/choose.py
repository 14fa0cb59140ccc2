"""Ladders of model sizes, and decisions from PSNR and bytes: when to stop growing, and which rungs to train in full."""

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
"""Growing continues while doubling the bytes gains `within_db / GAIN_DIVISOR`."""
MAX_RUNGS_WITHOUT_GAIN = 2
"""Consecutive rungs without sufficient gain after which growing stops: one may be chance."""
FULL_TRAINING_GAIN_DB = 1.0
"""Assumed gain of a full training over a rung's shorter one; 2 to 15 dB were measured in runs of 10 to 140 s."""
TOLERANCE_DB = 0.5
"""Uncertainty of a predicted PSNR."""


@dataclass(frozen=True)
class Ladder:
    """Model and sampler sizes to choose from."""

    rungs: list[Options]
    """Model options, smallest first."""
    samplers: list[Options]
    """Sampler options, coarsest first; empty for images."""


def read_ladder(name: str) -> Ladder:
    """Reads a ladder: a name in conf/ladders, or a YAML file.

    Raises:
        InputError: an unknown name, or an invalid file.
    """
    known = sorted(file.stem for file in (conf_dir() / "ladders").glob("*.yaml"))
    path = conf_dir() / "ladders" / f"{name}.yaml" if name in known else expand_user_path(name)
    if not path.is_file():
        raise InputError("rightsize", "ladder", name, f"one of {', '.join(known)}, or a YAML file with `rungs`")
    content = read_yaml(path, "a ladder in YAML")
    lists = content if isinstance(content, dict) else {}
    for key, min_length in (("rungs", 2), ("samplers", 0)):
        entries = lists.setdefault(key, [])
        valid = isinstance(entries, list) and all(isinstance(entry, dict) for entry in entries)
        if not valid or len(entries) < min_length:
            raise InputError(path, key, repr(entries), f"a list of {min_length} or more mappings of options")
    return Ladder(lists["rungs"], lists["samplers"])


@dataclass(frozen=True)
class Target:
    """The required quality: a PSNR, or a distance in dB from the best reachable one."""

    psnr: float | None = None
    within_db: float = 0.3


@dataclass(frozen=True)
class RungResult:
    """Quality and size of a trained rung."""

    psnr: float
    """Held-out PSNR, dB."""
    size: int
    """Compact file, bytes."""
    parameters: int = 0
    seconds: float = 0.0
    """Training time."""


def is_growth_finished(rungs: Sequence[RungResult], target: Target) -> bool:
    """Whether to stop growing: the target is near, or the last rungs gained too little for their bytes."""
    if target.psnr is not None:
        return rungs[-1].psnr >= target.psnr - FULL_TRAINING_GAIN_DB
    if len(rungs) <= MAX_RUNGS_WITHOUT_GAIN:
        return False
    # Compare with the best earlier rung, not the previous one: a dip and recovery gains nothing.
    base = max(rungs[:-MAX_RUNGS_WITHOUT_GAIN], key=lambda rung: rung.psnr)
    min_gain = target.within_db / GAIN_DIVISOR
    return all(
        rung.psnr - base.psnr <= min_gain * max(math.log2(rung.size / base.size), 1.0)
        for rung in rungs[-MAX_RUNGS_WITHOUT_GAIN:]
    )


def find_best(rungs: Sequence[RungResult]) -> int:
    """Index of the rung with the highest PSNR; the smallest if tied."""
    return max(range(len(rungs)), key=lambda rung: rungs[rung].psnr)


def choose_candidate(rungs: Sequence[RungResult], target: Target) -> int:
    """The rung to train in full first: the smallest that is probably good enough, else the best."""
    best = find_best(rungs)
    threshold = rungs[best].psnr - target.within_db if target.psnr is None else target.psnr - FULL_TRAINING_GAIN_DB
    return next((rung for rung, result in enumerate(rungs) if result.psnr >= threshold), best)


def choose_neighbor(first: int, psnr: float, rungs: Sequence[RungResult], target: Target, last: int) -> int | None:
    """The second rung to train in full, to confirm the choice; None if it is already certain.

    Args:
        first: see `choose_candidate`.
        psnr: its PSNR after full training, dB.
        rungs: results while growing.
        last: index of the largest rung.
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
    """The smallest fully trained rung that is good enough, else the best; and whether it is good enough."""
    best = max(full, key=lambda rung: full[rung].psnr)
    threshold = full[best].psnr - target.within_db if target.psnr is None else target.psnr
    sufficient = [rung for rung, result in full.items() if result.psnr >= threshold]
    return (min(sufficient), True) if sufficient else (best, False)
