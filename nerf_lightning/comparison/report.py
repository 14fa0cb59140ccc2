"""Everything a comparison leaves behind: compare.html, compare.png, compare.csv and the same on the terminal."""

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
"""Width of compare.png, and longest side of an image."""
MAX_IMAGES = 11
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
    caveats: list[str]
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
    runs: Sequence[RunSummary],
    output: Path,
    references: pd.DataFrame,
    within_db: float = 0.5,
    seconds: float = 15.0,
) -> pd.DataFrame:
    """Compares runs, writes compare.html, compare.png and compare.csv into a folder, and prints table and advice.

    Returns:
        The table: a row for each point, then one for each run that is in none.
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
    """A line for each run that did not end well, with its folder as seen from the one that holds all runs."""
    common = os.path.commonpath([run.folder.absolute().parent for run in runs])
    bad = [run for run in runs if run.status not in ("finished", "stopped_early") or not has_metrics(run)]
    return [f"{os.path.relpath(run.folder, common)}: {run.status}: {run.diagnosis}".rstrip(": ") for run in bad]


def tabulate(comparisons: Sequence[Comparison], runs: Sequence[RunSummary]) -> pd.DataFrame:
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


def collect_images(points: pd.DataFrame) -> list[tuple[str, UInt8[np.ndarray, "H W 3"]]]:
    """Captions and images of a held-out view, the truth first, then of the best points as far as they have one."""
    found: list[tuple[str, UInt8[np.ndarray, "H W 3"]]] = []
    for point in points.head(MAX_IMAGES).itertuples():
        run = find_median_run(point)
        for name, caption in (("truth", "truth"), ("final", f"{point.label}\n{run.psnr:.2f} dB")):
            with suppress(InputError):  # there is none, or it cannot be read
                if name == "final" or not found:
                    image = read_pixels(run.folder / f"{name}.png")[..., :3]
                    found.append((caption, fit_image(image, MAX_IMAGE_SIDE_PX, MAX_IMAGE_SIDE_PX)))
    return found


def draw_figure(comparisons: Sequence[Comparison], failures: Sequence[str]) -> UInt8[np.ndarray, "H W 3"]:
    """Panels, images and words of all comparisons, one below the other."""
    parts = []
    for one in comparisons[:MAX_COMPARISONS]:
        words = "\n".join([one.title, one.details, *one.advice, *one.caveats])
        captions, images = [caption for caption, _ in one.images], [image for _, image in one.images]
        parts.append(
            make_contact_sheet(one.panels, [""] * len(one.panels), 2, SHEET_WIDTH_PX, heading=words, text_px=12)
        )
        parts.append(make_contact_sheet(images, captions, 6, SHEET_WIDTH_PX, text_px=18))
    if failures:
        words = "\n".join([f"Failed, collapsed or cut short ({len(failures)}):", *failures[:MAX_FAILURES]])
        parts.append(make_contact_sheet([], [], 1, SHEET_WIDTH_PX, heading=words, text_px=12))
    return np.concatenate(parts)


def render_comparison_page(comparisons: Sequence[Comparison], failures: Sequence[str], folder: Path) -> str:
    """The page in a folder: rows link to the turnable page of a run, where it has one."""

    def find_page(point: Any) -> str | None:
        page = find_median_run(point).folder / FIELD_PAGE
        return relative_url(folder, page) if page.is_file() else None

    values: dict[str, Any] = {"cells": fill_cells, "find_page": find_page, "url": encode_data_url, "headings": HEADINGS}
    values |= {"comparisons": comparisons, "failures": failures, "caption": CAPTION}
    here = Path(__file__)
    return render_page(here.with_name("compare.html"), [here.with_name("compare.css")], title="Comparison", **values)


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
        print(f"{one.title}; {one.details}", table, CAPTION, *one.advice, *one.caveats, sep="\n")
    if failures:
        print("Failed, collapsed or cut short:", *failures, sep="\n")
