"""Output of a comparison: compare.html, compare.png, compare.csv and a terminal table."""

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import UInt8

from nerf_lightning.comparison.advice import list_caveats, recommend
from nerf_lightning.comparison.charts import draw_panels
from nerf_lightning.comparison.points import (
    COSTS,
    Conditions,
    compute_points,
    find_median_run,
    format_bytes,
    has_metrics,
)
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.drawing.contact_sheet import fit_image, make_contact_sheet
from nerf_lightning.drawing.panels import encode_data_url, write_png
from nerf_lightning.errors import InputError
from nerf_lightning.runs.summaries import FIELD_PAGE, RunSummary
from nerf_lightning.utils.files import atomic_write, write_text
from nerf_lightning.utils.html import relative_url, render_page

SHEET_WIDTH_PX, MAX_IMAGE_SIDE_PX = 1720, 480
"""Width of compare.png, and longest side of an image, pixels."""
MAX_IMAGES = 11
MAX_COMPARISONS, MAX_FAILURES = 4, 24
"""Limits for compare.png; the page and the table have all."""
HEADINGS = ("dB", "worst", "train s", "view s", "size", "runs", "frontier")
CAPTION = "dB: median over seeds; frontier: by T(raining time), R(endering time), S(ize)"


@dataclass(frozen=True)
class Comparison:
    """Points under the same conditions, with advice and charts."""

    conditions: Conditions
    points: pd.DataFrame
    """See `compute_points`."""
    advice: list[str]
    caveats: list[str]
    """Caveats, and sources of published results."""
    panels: list[UInt8[np.ndarray, "_ _ 3"]]
    images: list[tuple[str, UInt8[np.ndarray, "_ _ 3"]]]

    @property
    def title(self) -> str:
        return f"{self.conditions.scene}, {self.conditions.resolution}"

    @property
    def details(self) -> str:
        return "; ".join(filter(None, self.conditions[2:]))


def write_comparison(
    runs: Sequence[RunSummary], output: Path, references: pd.DataFrame, within_db: float = 0.5, seconds: float = 15.0
) -> pd.DataFrame:
    """Compares runs; writes compare.html, compare.png and compare.csv, and prints table and advice.

    Returns:
        The table: a row per point, then one per run that is in none.
    """
    comparisons = []
    for conditions, points in compute_points(runs):
        published = references[references["scene"].str.lower() == conditions.scene.lower()]
        advice = recommend(points, within_db, seconds)
        origins = [f"Published, other hardware: {origin}." for origin in published["origin"].unique()]
        panels, images = draw_panels(points, published), collect_images(points)
        comparisons.append(Comparison(conditions, points, advice, [*list_caveats(points), *origins], panels, images))
    failures, table = list_failures(runs), tabulate(comparisons, runs)
    with atomic_write(output / "compare.csv") as temporary:
        table.to_csv(temporary, index=False)
    write_png(output / "compare.png", draw_figure(comparisons, failures))
    write_text(output / "compare.html", render_comparison_page(comparisons, failures, output))
    print_comparisons(comparisons, failures)
    print(f"{output}: compare.html, compare.png, compare.csv")
    return table


def list_failures(runs: Sequence[RunSummary]) -> list[str]:
    """A line per failed run, with its folder relative to the common parent."""
    common = os.path.commonpath([run.folder.absolute().parent for run in runs])
    bad = [run for run in runs if run.status not in ("finished", "stopped_early") or not has_metrics(run)]
    return [f"{os.path.relpath(run.folder, common)}: {run.status}: {run.diagnosis}".rstrip(": ") for run in bad]


def tabulate(comparisons: Sequence[Comparison], runs: Sequence[RunSummary]) -> pd.DataFrame:
    """The table of compare.csv."""
    tables, charted = [], set()
    for comparison in comparisons:
        folders = [[str(run.folder) for run in runs_of_point] for runs_of_point in comparison.points["runs"]]
        ends = {"runs": [*map(len, folders)], **comparison.conditions._asdict(), "folders": [*map(";".join, folders)]}
        tables.append(comparison.points.drop(columns="options").assign(**ends, status="compared"))
        charted |= {folder for runs_of_point in folders for folder in runs_of_point}
    left_out = [run for run in runs if str(run.folder) not in charted]
    rows = [(run.folder.name, str(run.folder), run.status, run.diagnosis) for run in left_out]
    table = pd.concat([*tables, pd.DataFrame(rows, columns=["label", "folders", "status", "diagnosis"])])
    return table.replace([np.inf, -np.inf], np.nan)


def collect_images(points: pd.DataFrame) -> list[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
    """Captions and images of a held-out view: ground truth first, then the best points that have one."""
    images: list[tuple[str, UInt8[np.ndarray, "H W 3"]]] = []
    for point in points.head(MAX_IMAGES).itertuples():
        run = find_median_run(point)
        for name, caption in (("truth", "truth"), ("final", f"{point.label}\n{run.psnr:.2f} dB")):
            with suppress(InputError):  # missing or unreadable
                if name == "final" or not images:
                    image = read_pixels(run.folder / f"{name}.png")[..., :3]
                    images.append((caption, fit_image(image, MAX_IMAGE_SIDE_PX, MAX_IMAGE_SIDE_PX)))
    return images


def draw_figure(comparisons: Sequence[Comparison], failures: Sequence[str]) -> UInt8[np.ndarray, "H W 3"]:
    """Draws panels, images and advice of all comparisons below each other."""
    parts = []
    for comparison in comparisons[:MAX_COMPARISONS]:
        heading = "\n".join([comparison.title, comparison.details, *comparison.advice, *comparison.caveats])
        captions, images = [caption for caption, _ in comparison.images], [image for _, image in comparison.images]
        panels, blank = comparison.panels, [""] * len(comparison.panels)
        parts.append(make_contact_sheet(panels, blank, 2, SHEET_WIDTH_PX, heading=heading, text_px=12))
        parts.append(make_contact_sheet(images, captions, 6, SHEET_WIDTH_PX, text_px=18))
    if failures:
        heading = "\n".join([f"Failed, collapsed or cut short ({len(failures)}):", *failures[:MAX_FAILURES]])
        parts.append(make_contact_sheet([], [], 1, SHEET_WIDTH_PX, heading=heading, text_px=12))
    return np.concatenate(parts)


def render_comparison_page(comparisons: Sequence[Comparison], failures: Sequence[str], folder: Path) -> str:
    """Renders compare.html for a folder; rows link to a run's interactive page if it exists."""

    def find_page(point: Any) -> str | None:
        page = find_median_run(point).folder / FIELD_PAGE
        return relative_url(folder, page) if page.is_file() else None

    values: dict[str, Any] = {"cells": fill_cells, "find_page": find_page, "url": encode_data_url, "headings": HEADINGS}
    values |= {"comparisons": comparisons, "failures": failures, "caption": CAPTION}
    here = Path(__file__)
    return render_page(here.with_name("compare.html"), [here.with_name("compare.css")], title="Comparison", **values)


def fill_cells(point: Any) -> list[str]:
    """The table cells of a point, as in `HEADINGS`."""
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
    for comparison in comparisons:
        cells = [[point.label, *fill_cells(point)] for point in comparison.points.itertuples()]
        table = pd.DataFrame(cells, columns=["", *HEADINGS]).to_string(index=False)
        notes = *comparison.advice, *comparison.caveats
        print(f"{comparison.title}; {comparison.details}", table, CAPTION, *notes, sep="\n")
    if failures:
        print("Failed, collapsed or cut short:", *failures, sep="\n")
