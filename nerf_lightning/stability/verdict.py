"""Which trials failed: the verdict on a condition and a method over all seeds, and what the guard rescued."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median

from nerf_lightning.stability.conditions import CONDITIONS, METHODS, Condition
from nerf_lightning.stability.trial import Outcome

CLEAN = ("clean", "2D: clean")
RESCUED_DB = 2.0
"""A run counts as rescued within so many dB of an undisturbed one."""


@dataclass(frozen=True)
class Verdict:
    """All seeds of one condition and one method."""

    condition: Condition
    method: str
    outcomes: tuple[Outcome, ...]
    failed: tuple[Outcome, ...]
    """Those that did not pass the condition's check."""

    @property
    def worst(self) -> float | None:
        """dB of the worst seed; None if any seed has none."""
        known = [one.psnr for one in self.outcomes if one.psnr is not None]
        return min(known) if len(known) == len(self.outcomes) else None

    def describe(self) -> list[str]:
        """Figure and failures in words."""
        refused = all(one.status == "refused" for one in self.outcomes)
        parts = ["refused" if refused else "no figure" if self.worst is None else f"{self.worst:.1f} dB"]
        if self.failed:
            parts.append(f"{len(self.failed)}/{len(self.outcomes)} failed")
        elif self.condition.hopeless and not refused:
            parts.append("alarm")
        return parts


def judge(outcomes: Sequence[Outcome]) -> list[Verdict]:
    """By condition and method, in the order of the conditions."""
    found = []
    for condition in CONDITIONS.values():
        for method in dict.fromkeys(one.method for one in outcomes):
            seeds = select(outcomes, condition.name, method)
            failed = [one for one in seeds if not passes(one, condition, clean_psnr(outcomes, method, one.seed))]
            if seeds:
                found.append(Verdict(condition, method, tuple(seeds), tuple(failed)))
    return found


def passes(outcome: Outcome, condition: Condition, clean: float | None) -> bool:
    """Hopeless conditions must be refused or warned of; others trained, and no further below clean than allowed."""
    if condition.hopeless:
        return outcome.status == "refused" or bool(outcome.alarm)
    if outcome.status != "finished" or outcome.psnr is None:
        return False
    return condition.max_loss_db is None or clean is None or outcome.psnr >= clean - condition.max_loss_db


def find_rescues(outcomes: Sequence[Outcome]) -> list[bool]:
    """For each control run that broke down without the guard, whether its guarded twin came near an undisturbed run.

    That is the median of the seeds that did not break down under the same condition, or of the clean runs where all did.
    """
    found = []
    for lost in outcomes:
        guarded = METHODS[lost.method].guarded
        twins = select(outcomes, lost.condition, guarded, lost.seed) if guarded is not None else []
        if twins and lost.status in ("collapsed", "failed"):
            undisturbed = median_psnr(select(outcomes, lost.condition, lost.method)) or clean_psnr(
                outcomes, lost.method
            )
            psnr = twins[0].psnr
            found.append(psnr is not None and undisturbed is not None and psnr >= undisturbed - RESCUED_DB)
    return found


def select(outcomes: Sequence[Outcome], condition: str, method: str, seed: int | None = None) -> list[Outcome]:
    """Outcomes of one condition and one method, of all seeds or of one."""
    found = [one for one in outcomes if (one.condition, one.method) == (condition, method)]
    return found if seed is None else [one for one in found if one.seed == seed]


def clean_psnr(outcomes: Sequence[Outcome], method: str, seed: int | None = None) -> float | None:
    """dB of the same seed's clean run, as seeds differ; the median of all seeds if there is none."""
    clean = [one for name in CLEAN for one in select(outcomes, name, method)]
    return median_psnr([one for one in clean if one.seed == seed]) or median_psnr(clean)


def median_psnr(outcomes: Sequence[Outcome]) -> float | None:
    """Median dB of the runs that did not break down."""
    figures = [one.psnr for one in outcomes if one.psnr is not None and one.status == "finished"]
    return median(figures) if figures else None
