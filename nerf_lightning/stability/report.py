"""The files of a suite: stability.json, a heat map, a table in Markdown, and the worst renders."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.stability.cell import Outcome, folder_of
from nerf_lightning.stability.heatmap import heatmap
from nerf_lightning.stability.verdict import NEAR, Rescue, Square, rescues, squares
from nerf_lightning.stability.worst import worst_page
from nerf_lightning.utils.files import atomic, write_json


def write_report(outcomes: Sequence[Outcome], suite: str, root: Path) -> None:
    """Writes all files into the suite's folder and prints a summary."""
    found = squares(outcomes)
    saved = rescues(outcomes)
    whole = {"suite": suite, "cells": [asdict(one) for one in outcomes], "rescues": [asdict(one) for one in saved]}
    write_json(root / "stability.json", whole)
    seeds = max((len(square.outcomes) for square in found), default=0)
    title = f"worst of {seeds} seeds, dB held out; failed/all; suite={suite}"
    for name, flat in (("heatmap.png", False), ("heatmap_2d.png", True)):
        part = [square for square in found if square.condition.flat == flat]
        if part:
            write_png(root / name, pixels_of(heatmap(part, title)))
    page = worst_page(found, lambda one: folder_of(root, one.condition, one.method, one.seed))
    write_png(root / "worst.png", pixels_of(page))
    with atomic(root / "stability.md") as temporary:
        temporary.write_text("\n".join([markdown(found), *summary(found, saved)]) + "\n", encoding="utf-8")
    for square in found:
        if square.failed and not square.control:
            first = square.failed[0]
            print(
                f"{square.condition.name}, {square.method}: {len(square.failed)} of {len(square.outcomes)} failed"
                f" ({square.condition.check}); seed {first.seed}: {first.status}: {first.diagnosis}"
            )
    print("\n".join(summary(found, saved)))
    print(f"{len(outcomes)} cells: {root}/heatmap.png, worst.png, stability.md, stability.json")


def summary(found: Sequence[Square], saved: Sequence[Rescue]) -> list[str]:
    """The result in sentences."""
    shipped = [square for square in found if square.shipped]
    lost, tried = (sum(len(getattr(square, part)) for square in shipped) for part in ("failed", "outcomes"))
    controls = [square for square in found if square.control]
    lines = [f"shipped recipes: {lost} of {tried} cells failed"] if shipped else []
    if controls:
        failing = [
            f"{s.condition.name}, {s.method} ({len(s.failed)} of {len(s.outcomes)})" for s in controls if s.failed
        ]
        listed = "; ".join(failing) or "none, so this suite proves nothing"
        lines.append(f"controls that failed, as they should: {listed}")
    if saved:
        back = sum(one.back for one in saved)
        lines.append(f"guard: {back} of {len(saved)} broken control runs brought back to within {NEAR:g} dB")
    return lines


def markdown(found: Sequence[Square]) -> str:
    """A row for each condition, a column for each method."""
    methods = list(dict.fromkeys(square.method for square in found))
    rows: dict[str, dict[str, str]] = {}
    checks = {}
    for square in found:
        worst = square.worst
        told = "refused" if worst is None and not square.failed else "-" if worst is None else f"{worst:.1f} dB"
        if square.condition.hopeless and worst is not None and not square.failed:
            told += ", alarm"
        if square.failed:
            told += f", {len(square.failed)} of {len(square.outcomes)} failed"
        if square.recovered:
            told += f", {square.recovered} recovered"
        rows.setdefault(square.condition.name, {})[square.method] = told
        checks[square.condition.name] = square.condition.check
    lines = [f"| condition | must be | {' | '.join(methods)} |", "|---" * (len(methods) + 2) + "|"]
    for name, by_method in rows.items():
        cells = " | ".join(by_method.get(method, "") for method in methods)
        lines.append(f"| {name} | {checks[name]} | {cells} |")
    return "\n".join(lines) + "\n"
