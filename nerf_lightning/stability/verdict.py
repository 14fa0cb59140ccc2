"""Which cells failed, and the verdict on a condition and a method over all seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from nerf_lightning.stability.cell import Outcome
from nerf_lightning.stability.conditions import CONDITIONS, Condition
from nerf_lightning.stability.methods import METHODS

CLEAN = ("clean", "2D: clean")
NEAR = 2.0
"""A run counts as rescued within this many dB of an undisturbed one."""


@dataclass(frozen=True)
class Square:
    """All seeds of one condition and one method."""

    condition: Condition
    method: str
    outcomes: tuple[Outcome, ...]
    failed: tuple[Outcome, ...]
    """Those that did not pass the condition's check."""

    @property
    def worst(self) -> float | None:
        """dB of the worst seed; None if any seed has none."""
        figures = [one.psnr for one in self.outcomes]
        return None if None in figures else min(figure for figure in figures if figure is not None)

    @property
    def control(self) -> bool:
        """Whether it must fail."""
        method = METHODS[self.method]
        return self.condition.control or (method.control and not method.guard)

    @property
    def shipped(self) -> bool:
        """Whether it is a recipe as it is shipped, which must not fail."""
        return not self.condition.control and not METHODS[self.method].control

    @property
    def recovered(self) -> int:
        return sum(one.recoveries > 0 for one in self.outcomes)


def squares(outcomes: Sequence[Outcome]) -> list[Square]:
    """By condition and method, in the order of the conditions."""
    found = []
    methods = list(dict.fromkeys(one.method for one in outcomes))
    for condition in CONDITIONS:
        for method in methods:
            seeds = tuple(one for one in outcomes if (one.condition, one.method) == (condition.name, method))
            if seeds:
                failed = tuple(one for one in seeds if not passes(one, condition, _clean(outcomes, method, one.seed)))
                found.append(Square(condition, method, seeds, failed))
    return found


def passes(outcome: Outcome, condition: Condition, clean: float | None) -> bool:
    """Hopeless conditions must be refused or warned of; others trained, and no further below clean than allowed."""
    if condition.hopeless:
        return outcome.status == "refused" or bool(outcome.alarm)
    if outcome.status != "finished" or outcome.psnr is None:
        return False
    return condition.loses is None or clean is None or outcome.psnr >= clean - condition.loses


@dataclass(frozen=True)
class Rescue:
    """A run that breaks down without the guard, repeated with it."""

    condition: str
    method: str
    """With the guard."""
    seed: int
    psnr: float | None
    undisturbed: float | None
    """Median dB of the seeds that do not break down under the same condition, or of the clean runs where all do."""

    @property
    def back(self) -> bool:
        return self.psnr is not None and self.undisturbed is not None and self.psnr >= self.undisturbed - NEAR


def rescues(outcomes: Sequence[Outcome]) -> list[Rescue]:
    """Every control run that broke down without the guard, with the same run guarded."""
    by_cell = {(one.condition, one.method, one.seed): one for one in outcomes}
    found = []
    for lost in outcomes:
        guarded = METHODS[lost.method].guarded
        saved = by_cell.get((lost.condition, guarded, lost.seed)) if guarded else None
        if saved is None or lost.status not in ("collapsed", "failed"):
            continue
        undisturbed = _undisturbed(outcomes, (lost.condition,), lost.method) or _clean(outcomes, lost.method)
        found.append(Rescue(lost.condition, saved.method, lost.seed, saved.psnr, undisturbed))
    return found


def _clean(outcomes: Sequence[Outcome], method: str, seed: int | None = None) -> float | None:
    """dB of the same seed's clean run, as seeds differ; the median of all seeds if there is none."""
    alike = [one for one in outcomes if one.seed == seed]
    return _undisturbed(alike, CLEAN, method) or _undisturbed(outcomes, CLEAN, method)


def _undisturbed(outcomes: Sequence[Outcome], conditions: Sequence[str], method: str) -> float | None:
    """Median dB of the runs that did not break down."""
    mine = [one for one in outcomes if one.condition in conditions and one.method == method]
    figures = [one.psnr for one in mine if one.psnr is not None and one.status == "finished"]
    return median(figures) if figures else None
