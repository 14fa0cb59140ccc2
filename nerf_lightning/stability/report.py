"""Verdicts on a suite's trials, and its files: stability.json, heat maps, and the worst renders."""

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
from nerf_lightning.drawing.style import BLUE, DPI, GRAY, VERMILLION, rasterize_figure
from nerf_lightning.stability.conditions import CONDITIONS, METHODS, Condition
from nerf_lightning.stability.trial import TrialResult, get_trial_folder
from nerf_lightning.utils.files import write_json

COLOR_RANGE_DB = Normalize(8.0, 40.0, clip=True)
"""Range of the color scale."""
MAX_WORST_IMAGES = 30
CLEAN_CONDITIONS = ("clean", "2D: clean")
MAX_RESCUE_LOSS_DB = 2.0
"""Maximum PSNR loss of a recovered run against an undisturbed one."""


@dataclass(frozen=True)
class Verdict:
    """Results of all seeds of a condition and method."""

    condition: Condition
    method: str
    results: tuple[TrialResult, ...]
    failed: tuple[TrialResult, ...]
    """Results that fail the condition's check."""

    @property
    def worst(self) -> float | None:
        """PSNR of the worst seed; None if any seed has none."""
        known = [result.psnr for result in self.results if result.psnr is not None]
        return min(known) if len(known) == len(self.results) else None

    def describe(self) -> list[str]:
        """PSNR and failures in words."""
        refused = all(result.status == "refused" for result in self.results)
        parts = ["refused" if refused else "no figure" if self.worst is None else f"{self.worst:.1f} dB"]
        if self.failed:
            parts.append(f"{len(self.failed)}/{len(self.results)} failed")
        elif self.condition.is_unsolvable and not refused:
            parts.append("alarm")
        return parts


def judge_trials(results: Sequence[TrialResult]) -> list[Verdict]:
    """Judges trials: verdicts by condition and method, in the order of `CONDITIONS`."""
    verdicts = []
    for condition in CONDITIONS.values():
        for method in dict.fromkeys(result.method for result in results):
            seeds = select_results(results, condition.name, method)
            clean = {result.seed: get_clean_psnr(results, method, result.seed) for result in seeds}
            failed = tuple(result for result in seeds if not is_passed(result, condition, clean[result.seed]))
            if seeds:
                verdicts.append(Verdict(condition, method, tuple(seeds), failed))
    return verdicts


def is_passed(result: TrialResult, condition: Condition, clean: float | None) -> bool:
    """Whether a trial passes: unsolvable conditions must be refused or raise an alarm, others stay within `max_loss_db`."""
    if condition.is_unsolvable:
        return result.status == "refused" or bool(result.alarm)
    if result.status != "finished" or result.psnr is None:
        return False
    return condition.max_loss_db is None or clean is None or result.psnr >= clean - condition.max_loss_db


def find_rescues(results: Sequence[TrialResult]) -> list[bool]:
    """For each control run that diverged, whether its twin with recovery came close to an undisturbed run.

    That is the median of the seeds that finished under the same condition, or of the clean runs if none did.
    """
    rescues = []
    for control in results:
        twin = METHODS[control.method].recovery_twin
        twins = [] if twin is None else select_results(results, control.condition, twin, control.seed)
        if twins and control.status in ("collapsed", "failed"):
            others = select_results(results, control.condition, control.method)
            undisturbed = compute_median_psnr(others) or get_clean_psnr(results, control.method)
            psnr = twins[0].psnr
            rescues.append(psnr is not None and undisturbed is not None and psnr >= undisturbed - MAX_RESCUE_LOSS_DB)
    return rescues


def select_results(
    results: Sequence[TrialResult], condition: str, method: str, seed: int | None = None
) -> list[TrialResult]:
    """Results of a condition and method, for one seed or all."""
    selected = [result for result in results if (result.condition, result.method) == (condition, method)]
    return selected if seed is None else [result for result in selected if result.seed == seed]


def get_clean_psnr(results: Sequence[TrialResult], method: str, seed: int | None = None) -> float | None:
    """PSNR of the same seed's clean run; the median of all seeds if there is none."""
    clean = [result for name in CLEAN_CONDITIONS for result in select_results(results, name, method)]
    return compute_median_psnr([result for result in clean if result.seed == seed]) or compute_median_psnr(clean)


def compute_median_psnr(results: Sequence[TrialResult]) -> float | None:
    """Median PSNR of the finished runs; None if none finished."""
    figures = [result.psnr for result in results if result.psnr is not None and result.status == "finished"]
    return median(figures) if figures else None


def write_report(results: Sequence[TrialResult], suite: str, root: Path) -> dict[str, Any]:
    """Writes all files into the suite's folder, prints a summary, and returns the content of stability.json."""
    verdicts = judge_trials(results)
    lines = summarize(verdicts, find_rescues(results))
    for name, is_2d in (("heatmap.png", False), ("heatmap_2d.png", True)):
        part = [verdict for verdict in verdicts if verdict.condition.is_2d == is_2d]
        if part:
            write_png(root / name, rasterize_figure(draw_heatmap(part, suite)))
    write_worst(verdicts, root)
    content = {"suite": suite, "summary": lines, "cells": [asdict(result) for result in results]}
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
    shipped = [verdict for verdict in verdicts if not verdict.condition.control and not METHODS[verdict.method].control]
    controls, lines = [verdict for verdict in verdicts if is_expected_to_fail(verdict)], []
    if shipped:
        failed = sum(len(verdict.failed) for verdict in shipped)
        total = sum(len(verdict.results) for verdict in shipped)
        lines.append(f"shipped recipes: {failed} of {total} trials failed")
    if controls:
        failing = [v for v in controls if v.failed]
        names = "; ".join(f"{v.condition.name}, {v.method} ({v.describe()[-1]})" for v in failing)
        listed = names or "none, so this suite proves nothing"
        lines.append(f"controls that failed, as they should: {listed}")
    if rescues:
        number = f"{sum(rescues)} of {len(rescues)} diverged control runs"
        lines.append(f"recovery: {number} recovered to within {MAX_RESCUE_LOSS_DB:g} dB")
    return lines


def draw_heatmap(verdicts: Sequence[Verdict], suite: str) -> Figure:
    """Heat map of conditions (rows) by methods (columns): bluer is better, vermillion marks failures."""
    conditions = list(dict.fromkeys(verdict.condition.name for verdict in verdicts))
    methods = list(dict.fromkeys(verdict.method for verdict in verdicts))
    figure = Figure(figsize=(3.2 + 1.35 * len(methods), 1.4 + 0.34 * len(conditions)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    blues = LinearSegmentedColormap.from_list("blues", ["white", BLUE])
    cells = {(verdict.condition.name, verdict.method): verdict for verdict in verdicts}
    for (row, condition), (column, method) in itertools.product(enumerate(conditions), enumerate(methods)):
        verdict = cells.get((condition, method))
        shade = 0.0 if verdict is None or verdict.worst is None else float(COLOR_RANGE_DB(verdict.worst))
        color = "#eeeeee" if verdict is None else VERMILLION if verdict.failed else blues(shade) if shade else "#d8d8d8"
        text_color = GRAY if verdict is None else "white" if verdict.failed or shade > 0.6 else "black"
        axes.add_patch(Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=color, edgecolor="white"))
        words = "–" if verdict is None else ", ".join(verdict.describe())
        axes.text(column, row, words, ha="center", va="center", fontsize=8.5, color=text_color)
    axes.set(xlim=(-0.5, len(methods) - 0.5), ylim=(len(conditions) - 0.5, -0.5))
    axes.set_xticks(range(len(methods)), methods, fontsize=9)
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(conditions)), conditions, fontsize=9)
    axes.tick_params(length=0)
    seeds = max(len(verdict.results) for verdict in verdicts)
    note = "" if len(cells) == len(conditions) * len(methods) else "; –: does not apply"
    axes.set_xlabel(f"worst seed of {seeds}, held out; suite {suite}{note}", color=GRAY, fontsize=9)
    axes.spines[:].set_visible(False)
    return figure


def write_worst(verdicts: Sequence[Verdict], root: Path) -> None:
    """Writes worst.png: the final render of the worst seed of each condition and method, worst first."""
    shown = []
    for verdict in verdicts:
        result = min(verdict.results, key=lambda result: (result.psnr is not None, result.psnr))
        folder = get_trial_folder(root, result.condition, result.method, result.seed)
        files = [folder / name for name in ("enlarged.png", "final.png") if (folder / name).exists()]
        if files:
            figure = "no figure" if result.psnr is None else f"{result.psnr:.1f} dB"
            caption = f"{result.condition}\n{result.method}\nseed {result.seed}: {figure}"
            shown.append((result.psnr or 0.0, caption, imageio.imread(files[0]), result in verdict.failed))
    shown = sorted(shown, key=lambda entry: entry[0])[:MAX_WORST_IMAGES]
    if shown:
        _, captions, images, failed = zip(*shown, strict=True)
        sheet = make_contact_sheet(images, captions, 6, 1200, {i for i, flag in enumerate(failed) if flag})
        write_png(root / "worst.png", sheet)
