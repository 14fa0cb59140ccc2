"""The files of a suite: stability.json, heat maps, and the worst renders."""

import itertools
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from nerf_lightning.drawing.contact_sheet import contact_sheet
from nerf_lightning.drawing.ink import BLUE, DPI, GREY, VERMILLION, pixels_of
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.stability.conditions import METHODS
from nerf_lightning.stability.trial import Outcome, trial_folder
from nerf_lightning.stability.verdict import RESCUED_DB, Verdict, find_rescues, judge
from nerf_lightning.utils.files import write_json

SCALE_DB = Normalize(8.0, 40.0, clip=True)
"""Ends of the colours."""
MAX_WORST = 30


def write_report(outcomes: Sequence[Outcome], suite: str, root: Path) -> dict[str, Any]:
    """Writes all files into the suite's folder, prints a summary, and returns what stability.json holds."""
    verdicts = judge(outcomes)
    lines = summarize(verdicts, find_rescues(outcomes))
    for name, flat in (("heatmap.png", False), ("heatmap_2d.png", True)):
        part = [one for one in verdicts if one.condition.flat == flat]
        if part:
            write_png(root / name, pixels_of(draw_heatmap(part, suite)))
    write_worst(verdicts, root)
    content = {"suite": suite, "summary": lines, "cells": [asdict(one) for one in outcomes]}
    write_json(root / "stability.json", content)
    for verdict in verdicts:
        if verdict.failed and not must_fail(verdict):
            name, first = f"{verdict.condition.name}, {verdict.method}", verdict.failed[0]
            words = f"{verdict.describe()[-1]} ({verdict.condition.check})"
            print(f"{name}: {words}; seed {first.seed}: {first.status}: {first.diagnosis}")
    print("\n".join(lines))
    print(f"{len(outcomes)} trials: {root}/heatmap.png, worst.png, stability.json")
    return content


def must_fail(verdict: Verdict) -> bool:
    return verdict.condition.control or METHODS[verdict.method].guarded is not None


def summarize(verdicts: Sequence[Verdict], rescues: Sequence[bool]) -> list[str]:
    """The result in sentences."""
    shipped = [one for one in verdicts if not one.condition.control and not METHODS[one.method].control]
    controls, lines = [one for one in verdicts if must_fail(one)], []
    if shipped:
        lost, tried = sum(len(one.failed) for one in shipped), sum(len(one.outcomes) for one in shipped)
        lines.append(f"shipped recipes: {lost} of {tried} trials failed")
    if controls:
        failing = [f"{one.condition.name}, {one.method} ({one.describe()[-1]})" for one in controls if one.failed]
        listed = "; ".join(failing) or "none, so this suite proves nothing"
        lines.append(f"controls that failed, as they should: {listed}")
    if rescues:
        number = f"{sum(rescues)} of {len(rescues)} broken control runs"
        lines.append(f"guard: {number} brought back to within {RESCUED_DB:g} dB")
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
        shade = 0.0 if one is None or one.worst is None else float(SCALE_DB(one.worst))
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
    seeds = max(len(one.outcomes) for one in verdicts)
    note = "" if len(cells) == len(conditions) * len(methods) else "; –: does not apply"
    axes.set_xlabel(f"worst seed of {seeds}, held out; suite {suite}{note}", color=GREY, fontsize=9)
    axes.spines[:].set_visible(False)
    return figure


def write_worst(verdicts: Sequence[Verdict], root: Path) -> None:
    """Writes worst.png: the last render of the worst seed of each condition and method, the worst first."""
    shown = []
    for verdict in verdicts:
        one = min(verdict.outcomes, key=lambda outcome: (outcome.psnr is not None, outcome.psnr))
        folder = trial_folder(root, one.condition, one.method, one.seed)
        files = [folder / name for name in ("enlarged.png", "final.png") if (folder / name).exists()]
        if files:
            figure = "no figure" if one.psnr is None else f"{one.psnr:.1f} dB"
            caption = f"{one.condition}\n{one.method}\nseed {one.seed}: {figure}"
            shown.append((one.psnr or 0.0, caption, imageio.imread(files[0]), one in verdict.failed))
    shown = sorted(shown, key=lambda entry: entry[0])[:MAX_WORST]
    if shown:
        _, captions, images, failed = zip(*shown, strict=True)
        sheet = contact_sheet(images, captions, 6, 1200, {i for i, flag in enumerate(failed) if flag})
        write_png(root / "worst.png", sheet)
