"""Which trials of a suite failed, and its files: stability.json, heat maps, and the worst renders."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Any

import imageio.v3 as imageio
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from nerf_lightning.drawing.contact_sheet import make_contact_sheet
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.drawing.style import BLUE, DPI, GREY, VERMILLION, rasterize_figure
from nerf_lightning.stability.conditions import CONDITIONS, METHODS, Condition
from nerf_lightning.stability.trial import TrialResult, get_trial_folder
from nerf_lightning.utils.files import write_json

COLOUR_RANGE_DB = Normalize(8.0, 40.0, clip=True)
"""Ends of the colours."""
MAX_WORST_IMAGES = 30
CLEAN_CONDITIONS = ("clean", "2D: clean")
MAX_RESCUE_LOSS_DB = 2.0
"""A run counts as rescued within so many dB of an undisturbed one."""


@dataclass(frozen=True)
class Verdict:
    """All seeds of one condition and one method."""

    condition: Condition
    method: str
    results: tuple[TrialResult, ...]
    failed: tuple[TrialResult, ...]
    """Those that did not pass the condition's check."""

    @property
    def worst(self) -> float | None:
        """dB of the worst seed; None if any seed has none."""
        known = [one.psnr for one in self.results if one.psnr is not None]
        return min(known) if len(known) == len(self.results) else None

    def describe(self) -> list[str]:
        """Figure and failures in words."""
        refused = all(one.status == "refused" for one in self.results)
        parts = ["refused" if refused else "no figure" if self.worst is None else f"{self.worst:.1f} dB"]
        if self.failed:
            parts.append(f"{len(self.failed)}/{len(self.results)} failed")
        elif self.condition.is_unsolvable and not refused:
            parts.append("alarm")
        return parts


def judge(results: Sequence[TrialResult]) -> list[Verdict]:
    """By condition and method, in the order of the conditions."""
    found = []
    for condition in CONDITIONS.values():
        for method in dict.fromkeys(one.method for one in results):
            seeds = select_results(results, condition.name, method)
            failed = [one for one in seeds if not is_passed(one, condition, get_clean_psnr(results, method, one.seed))]
            if seeds:
                found.append(Verdict(condition, method, tuple(seeds), tuple(failed)))
    return found


def is_passed(result: TrialResult, condition: Condition, clean: float | None) -> bool:
    """Hopeless conditions must be refused or warned of; others trained, and no further below clean than allowed."""
    if condition.is_unsolvable:
        return result.status == "refused" or bool(result.alarm)
    if result.status != "finished" or result.psnr is None:
        return False
    return condition.max_loss_db is None or clean is None or result.psnr >= clean - condition.max_loss_db


def find_rescues(results: Sequence[TrialResult]) -> list[bool]:
    """For each control run that broke down without the guard, whether its guarded twin came near an undisturbed run.

    That is the median of the seeds that did not break down under the same condition, or of the clean runs where all did.
    """
    found = []
    for lost in results:
        recovery_twin = METHODS[lost.method].recovery_twin
        twins = select_results(results, lost.condition, recovery_twin, lost.seed) if recovery_twin is not None else []
        if twins and lost.status in ("collapsed", "failed"):
            undisturbed = compute_median_psnr(select_results(results, lost.condition, lost.method)) or get_clean_psnr(
                results, lost.method
            )
            psnr = twins[0].psnr
            found.append(psnr is not None and undisturbed is not None and psnr >= undisturbed - MAX_RESCUE_LOSS_DB)
    return found


def select_results(
    results: Sequence[TrialResult], condition: str, method: str, seed: int | None = None
) -> list[TrialResult]:
    """Outcomes of one condition and one method, of all seeds or of one."""
    found = [one for one in results if (one.condition, one.method) == (condition, method)]
    return found if seed is None else [one for one in found if one.seed == seed]


def get_clean_psnr(results: Sequence[TrialResult], method: str, seed: int | None = None) -> float | None:
    """dB of the same seed's clean run, as seeds differ; the median of all seeds if there is none."""
    clean = [one for name in CLEAN_CONDITIONS for one in select_results(results, name, method)]
    return compute_median_psnr([one for one in clean if one.seed == seed]) or compute_median_psnr(clean)


def compute_median_psnr(results: Sequence[TrialResult]) -> float | None:
    """Median dB of the runs that did not break down."""
    figures = [one.psnr for one in results if one.psnr is not None and one.status == "finished"]
    return median(figures) if figures else None


def write_report(results: Sequence[TrialResult], suite: str, root: Path) -> dict[str, Any]:
    """Writes all files into the suite's folder, prints a summary, and returns what stability.json holds."""
    verdicts = judge(results)
    lines = summarize(verdicts, find_rescues(results))
    for name, is_2d in (("heatmap.png", False), ("heatmap_2d.png", True)):
        part = [one for one in verdicts if one.condition.is_2d == is_2d]
        if part:
            write_png(root / name, rasterize_figure(draw_heatmap(part, suite)))
    write_worst(verdicts, root)
    content = {"suite": suite, "summary": lines, "cells": [asdict(one) for one in results]}
    write_json(root / "stability.json", content)
    for verdict in verdicts:
        if verdict.failed and not is_expected_to_fail(verdict):
            name, first = f"{verdict.condition.name}, {verdict.method}", verdict.failed[0]
            words = f"{verdict.describe()[-1]} ({verdict.condition.check})"
            print(f"{name}: {words}; seed {first.seed}: {first.status}: {first.diagnosis}")
    print("\n".join(lines))
    print(f"{len(results)} trials: {root}/heatmap.png, worst.png, stability.json")
    return content


def is_expected_to_fail(verdict: Verdict) -> bool:
    return verdict.condition.control or METHODS[verdict.method].recovery_twin is not None


def summarize(verdicts: Sequence[Verdict], rescues: Sequence[bool]) -> list[str]:
    """The result in sentences."""
    shipped = [one for one in verdicts if not one.condition.control and not METHODS[one.method].control]
    controls, lines = [one for one in verdicts if is_expected_to_fail(one)], []
    if shipped:
        lost, tried = sum(len(one.failed) for one in shipped), sum(len(one.results) for one in shipped)
        lines.append(f"shipped recipes: {lost} of {tried} trials failed")
    if controls:
        failing = [f"{one.condition.name}, {one.method} ({one.describe()[-1]})" for one in controls if one.failed]
        listed = "; ".join(failing) or "none, so this suite proves nothing"
        lines.append(f"controls that failed, as they should: {listed}")
    if rescues:
        number = f"{sum(rescues)} of {len(rescues)} broken control runs"
        lines.append(f"guard: {number} brought back to within {MAX_RESCUE_LOSS_DB:g} dB")
    return lines


def draw_heatmap(verdicts: Sequence[Verdict], suite: str) -> Figure:
    """A row for each condition, a column for each method: the bluer the better, vermillion where seeds failed."""
    conditions = list(dict.fromkeys(one.condition.name for one in verdicts))
    methods = list(dict.fromkeys(one.method for one in verdicts))
    figure = Figure(figsize=(3.2 + 1.35 * len(methods), 1.4 + 0.34 * len(conditions)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    blues = LinearSegmentedColormap.from_list("blues", ["white", BLUE])
    cells = {(one.condition.name, one.method): one for one in verdicts}
    for (row, condition), (column, method) in itertools.product(enumerate(conditions), enumerate(methods)):
        one = cells.get((condition, method))
        shade = 0.0 if one is None or one.worst is None else float(COLOUR_RANGE_DB(one.worst))
        colour = "#eeeeee" if one is None else VERMILLION if one.failed else blues(shade) if shade else "#d8d8d8"
        ink = GREY if one is None else "white" if one.failed or shade > 0.6 else "black"
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, edgecolor="white"))
        words = "–" if one is None else ", ".join(one.describe())
        axes.text(column, row, words, ha="center", va="center", fontsize=8.5, color=ink)
    axes.set(xlim=(-0.5, len(methods) - 0.5), ylim=(len(conditions) - 0.5, -0.5))
    axes.set_xticks(range(len(methods)), methods, fontsize=9)
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(conditions)), conditions, fontsize=9)
    axes.tick_params(length=0)
    seeds = max(len(one.results) for one in verdicts)
    note = "" if len(cells) == len(conditions) * len(methods) else "; –: does not apply"
    axes.set_xlabel(f"worst seed of {seeds}, held out; suite {suite}{note}", color=GREY, fontsize=9)
    axes.spines[:].set_visible(False)
    return figure


def write_worst(verdicts: Sequence[Verdict], root: Path) -> None:
    """Writes worst.png: the last render of the worst seed of each condition and method, the worst first."""
    shown = []
    for verdict in verdicts:
        one = min(verdict.results, key=lambda result: (result.psnr is not None, result.psnr))
        folder = get_trial_folder(root, one.condition, one.method, one.seed)
        files = [folder / name for name in ("enlarged.png", "final.png") if (folder / name).exists()]
        if files:
            figure = "no figure" if one.psnr is None else f"{one.psnr:.1f} dB"
            caption = f"{one.condition}\n{one.method}\nseed {one.seed}: {figure}"
            shown.append((one.psnr or 0.0, caption, imageio.imread(files[0]), one in verdict.failed))
    shown = sorted(shown, key=lambda entry: entry[0])[:MAX_WORST_IMAGES]
    if shown:
        _, captions, images, failed = zip(*shown, strict=True)
        sheet = make_contact_sheet(images, captions, 6, 1200, {i for i, flag in enumerate(failed) if flag})
        write_png(root / "worst.png", sheet)
