"""Everything a comparison leaves behind: compare.html, compare.png, compare.csv and the same on the terminal."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import UInt8

from nerf_lightning.compare.advice import list_caveats, recommend
from nerf_lightning.compare.charts import draw_panels
from nerf_lightning.compare.images import collect_images
from nerf_lightning.compare.points import COSTS, Conditions, compute_points, format_bytes, typical_run
from nerf_lightning.drawing.contact_sheet import contact_sheet
from nerf_lightning.drawing.panels import data_url, write_png
from nerf_lightning.runs.index import FIELD_PAGE, Run
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.html import address_from, render_page

SHEET_PX = 1720
"""Width of compare.png."""
MAX_COMPARISONS, MAX_FAILURES = 4, 24
"""In compare.png; the page and the table have all."""
HEADINGS = ("dB", "worst", "train s", "view s", "size", "runs", "frontier")
CAPTION = "dB: median over seeds; frontier: by T(raining time), R(endering time), S(ize)"


@dataclass(frozen=True)
class Comparison:
    """Points that were made under the same conditions, and what to say about them."""

    conditions: Conditions
    points: pd.DataFrame
    """See `compute_points`."""
    advice: list[str]
    remarks: list[str]
    """Caveats, and where published figures are from."""
    panels: list[UInt8[np.ndarray, "_ _ 3"]]
    images: list[tuple[str, UInt8[np.ndarray, "_ _ 3"]]]

    @property
    def title(self) -> str:
        return f"{self.conditions.scene}, {self.conditions.resolution}"

    @property
    def details(self) -> str:
        return "; ".join(filter(None, self.conditions[2:]))


def write_comparison(
    runs: Sequence[Run],
    output: Path,
    references: pd.DataFrame,
    within_db: float = 0.5,
    seconds: float = 15.0,
    smallest_within_db: float = 1.0,
) -> pd.DataFrame:
    """Compares runs, writes compare.html, compare.png and compare.csv into a folder, and prints table and advice.

    Returns:
        The table: a row for each point, then one for each run that is in none.
    """
    comparisons = []
    for conditions, points in compute_points(runs):
        published = references[references["scene"].str.lower() == conditions.scene.lower()]
        advice = recommend(points, within_db, seconds, smallest_within_db)
        origins = [f"Published, other hardware: {origin}." for origin in published["origin"].unique()]
        panels, images = draw_panels(points, published), collect_images(points)
        comparisons.append(Comparison(conditions, points, advice, [*list_caveats(points), *origins], panels, images))
    failures = list_failures(runs)
    table = tabulate(comparisons, runs)
    with atomic(output / "compare.csv") as temporary:
        table.to_csv(temporary, index=False)
    write_png(output / "compare.png", draw_figure(comparisons, failures))
    with atomic(output / "compare.html") as temporary:
        temporary.write_text(fill_page(comparisons, failures, output), encoding="utf-8")
    print_comparisons(comparisons, failures)
    print(f"{output}: compare.html, compare.png, compare.csv")
    return table


def list_failures(runs: Sequence[Run]) -> list[str]:
    """A line for each run that did not end well, with its folder as seen from the one that holds all runs."""
    common = os.path.commonpath([run.folder.absolute().parent for run in runs])
    bad = [run for run in runs if run.status not in ("finished", "stopped_early") or run.psnr is None]
    return [f"{os.path.relpath(run.folder, common)}: {run.status}: {run.diagnosis}".rstrip(": ") for run in bad]


def tabulate(comparisons: Sequence[Comparison], runs: Sequence[Run]) -> pd.DataFrame:
    """What compare.csv holds."""
    tables, charted = [], set()
    for one in comparisons:
        folders = [[str(run.folder) for run in some] for some in one.points["runs"]]
        ends = {"runs": [*map(len, folders)], **one.conditions._asdict(), "folders": [*map(";".join, folders)]}
        tables.append(one.points.drop(columns="options").assign(**ends, status="compared"))
        charted |= {folder for some in folders for folder in some}
    left_out = [run for run in runs if str(run.folder) not in charted]
    rows = [(run.folder.name, str(run.folder), run.status, run.diagnosis) for run in left_out]
    table = pd.concat([*tables, pd.DataFrame(rows, columns=["label", "folders", "status", "diagnosis"])])
    return table.replace([np.inf, -np.inf], np.nan)


def draw_figure(comparisons: Sequence[Comparison], failures: Sequence[str]) -> UInt8[np.ndarray, "H W 3"]:
    """Panels, images and words of all comparisons, one below the other."""

    def write(lines: Sequence[str], text_px: int) -> UInt8[np.ndarray, "H W 3"]:
        return contact_sheet([], [], 1, SHEET_PX, heading="\n".join(lines), text_px=text_px)

    parts = []
    for one in comparisons[:MAX_COMPARISONS]:
        parts += [write([one.title], 20), write([one.details, *one.advice, *one.remarks], 12)]
        count = len(one.panels)
        parts.append(contact_sheet(one.panels, [""] * count, choose_columns(count, 3), SHEET_PX))
        if one.images:
            captions, images = zip(*one.images, strict=True)
            parts.append(contact_sheet(images, captions, choose_columns(len(images), 6), SHEET_PX, text_px=18))
    left_out = len(comparisons) - MAX_COMPARISONS
    if left_out > 0:
        parts.append(write([f"{left_out} more comparisons are in compare.html"], 12))
    if failures:
        more = len(failures) - MAX_FAILURES
        ends = [f"and {more} more, all in compare.csv"] if more > 0 else []
        parts.append(write(["Failed, collapsed or cut short:", *failures[:MAX_FAILURES], *ends], 12))
    return np.concatenate(parts)


def choose_columns(count: int, most: int) -> int:
    """How many columns leave the fewest cells empty; of several the most, but not one alone."""
    return min(range(min(count, most), 0, -1), key=lambda columns: -count % columns + (columns == 1) * most)


def fill_page(comparisons: Sequence[Comparison], failures: Sequence[str], folder: Path) -> str:
    """The page in a folder: rows link to the turnable page of a run, where it has one."""

    def fill_row(point: Any) -> dict[str, Any]:
        page = typical_run(point).folder / FIELD_PAGE
        address = address_from(folder, page) if page.is_file() else None
        return {"label": point.label, "cells": fill_cells(point), "page": address, "options": point.options}

    shown = [
        {
            "comparison": one,
            "rows": [fill_row(point) for point in one.points.itertuples()],
            "images": [(caption, data_url(image, ".webp")) for caption, image in one.images],
            "charts": [data_url(panel, ".png") for panel in one.panels],
        }
        for one in comparisons
    ]
    here, words = Path(__file__), {"headings": HEADINGS, "caption": CAPTION, "failures": failures}
    style = here.with_name("compare.css")
    return render_page(here.with_name("compare.html"), [style], title="Comparison", shown=shown, **words)


def fill_cells(point: Any) -> list[str]:
    """A point's row below `HEADINGS`."""
    return [
        f"{point.psnr:.2f}",
        "collapsed" if np.isinf(point.psnr_min) else f"{point.psnr_min:.2f}",
        f"{point.train_seconds:.3g}",
        "" if np.isnan(point.render_seconds) else f"{point.render_seconds:.2g}",
        "" if np.isnan(point.bytes) else format_bytes(point.bytes),
        f"{len(point.runs)}" + (f", {point.collapsed} collapsed" if point.collapsed else ""),
        " ".join(COSTS[cost][0].upper() for cost in point.frontier.split()),
    ]


def print_comparisons(comparisons: Sequence[Comparison], failures: Sequence[str]) -> None:
    """The same on the terminal."""
    for one in comparisons:
        cells = [[point.label, *fill_cells(point)] for point in one.points.itertuples()]
        table = pd.DataFrame(cells, columns=["", *HEADINGS]).to_string(index=False)
        print(f"{one.title}; {one.details}", table, CAPTION, *one.advice, *one.remarks, sep="\n")
    if failures:
        print("Failed, collapsed or cut short:", *failures, sep="\n")
