"""Which cells failed, and what a condition and a method come to over all seeds."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from nerf_lightning.stability.cell import Outcome
from nerf_lightning.stability.conditions import CONDITIONS, Condition

CLEAN = ("clean", "2D: clean")


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
        """dB of the worst seed; None where one has no figure."""
        figures = [one.psnr for one in self.outcomes]
        return None if None in figures else min(figure for figure in figures if figure is not None)

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
                clean = _clean(outcomes, method)
                failed = tuple(one for one in seeds if not passes(one, condition, clean))
                found.append(Square(condition, method, seeds, failed))
    return found


def passes(outcome: Outcome, condition: Condition, clean: float | None) -> bool:
    """The condition's check: refused or told where nothing can work; else trained, and no further below clean than allowed."""
    if condition.hopeless:
        return outcome.status == "refused" or bool(outcome.alarm)
    if outcome.status != "finished" or outcome.psnr is None:
        return False
    return condition.loses is None or clean is None or outcome.psnr >= clean - condition.loses


def _clean(outcomes: Sequence[Outcome], method: str) -> float | None:
    figures = [one.psnr for one in outcomes if one.condition in CLEAN and one.method == method and one.psnr is not None]
    return median(figures) if figures else None
