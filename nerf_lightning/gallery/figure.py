"""All runs of a sweep in one picture: the last render of each, its PSNR, and its curve."""

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure

from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.dataset.resize import area_resize, fit_size
from nerf_lightning.drawing.ink import BLUE, DPI, GREY, VERMILLION, pixels_of, readable, shortened
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.errors import InputError
from nerf_lightning.runs.index import FINISHED, Run, varied

MOST = 60
"""Pictures in a figure; of more runs the best are shown."""
WIDEST = 10
"""Columns of a table that stay readable."""
SIDE = 320
"""Pixels of a picture's longer side."""
CELL = 2.3
"""Inches."""


def write_contact_figure(root: Path, runs: Sequence[Run], output: Path | None = None) -> Path:
    """Draws the runs found below a folder into a PNG, gallery.png in that folder by default; returns its path."""
    names = {str((run.results.get("scene") or {}).get("name", "")) for run in runs} - {""}
    scenes = [shortened(name, 60) for name in sorted(names)]
    path = root / "gallery.png" if output is None else output
    title = ": ".join(["/".join(root.resolve().parts[-2:]), *filter(None, [", ".join(scenes)])])
    write_png(path, pixels_of(contact_figure(runs, title)))
    return path


def contact_figure(runs: Sequence[Run], title: str) -> Figure:
    """A contact sheet with the PSNR under each picture, beside final quality by option and all curves.

    Two options that vary give rows and columns; more are written under each picture. Runs that collapsed or failed are framed
    in red, and their diagnosis is written below.
    """
    keys = varied(runs)
    shown = list(runs)
    if len(shown) > MOST:
        shown = sorted(runs, key=_quality, reverse=True)[:MOST]
        title = f"{title} (the best {MOST} of {len(runs)} runs)"
    cells = _arranged(shown, keys)
    troubles = [_trouble(run, keys) for run in shown if run.status != "finished" and run.diagnosis]
    rows, columns = len(cells), len(cells[0])
    sheet_width, sheet_height = columns * CELL, rows * (CELL + 0.45)
    notes = "\n".join(
        line for trouble in troubles[:12] for line in textwrap.wrap(readable(trouble), round(sheet_width * 12 + 90))
    )
    note_height = 0.2 * (notes.count("\n") + 1) + 0.2 if notes else 0.0
    height = max(sheet_height, 5.0) + note_height + 0.5
    figure = Figure(figsize=(sheet_width + 6.5, height), dpi=DPI, layout="constrained")
    figure.suptitle(readable(title), fontsize=12)
    shares = (height - note_height, max(note_height, 0.01))
    parts: Any = figure.subfigures(2, 1, height_ratios=shares)
    left, right = parts[0].subfigures(1, 2, width_ratios=(sheet_width, 6.5))
    _sheet(left, cells, keys)
    charts = right.subplots(2 if keys else 1, 1, squeeze=False)[:, 0]
    _curves(charts[0], shown, keys)
    if keys:
        _by_option(charts[1], shown, keys)
    if notes:
        parts[1].text(0.01, 0.98, notes, va="top", fontsize=9, color=VERMILLION, parse_math=False)
    return figure


def name_of(key: str) -> str:
    """The last part of a dotted key."""
    return key.rsplit(".", 1)[-1].replace("_", " ")


def label(run: Run, keys: Sequence[str]) -> str:
    """The options by which a run differs from the others."""
    return ", ".join(f"{name_of(key)} {_text(run.option(key))}" for key in keys) or run.folder.name


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _quality(run: Run) -> float:
    return -math.inf if run.psnr is None else run.psnr


def _rank(value: Any) -> tuple[int, float, str]:
    """Orders numbers by size, before everything else by its letters."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (0, float(value), "") if number else (1, 0.0, str(value))


def _ordered(runs: Sequence[Run], keys: Sequence[str]) -> list[Run]:
    """Runs sorted by the values of some options."""
    return sorted(runs, key=lambda run: [_rank(run.option(key)) for key in keys])


def _values(runs: Sequence[Run], key: str) -> list[Any]:
    """The values of an option, sorted, each once (lists as they are written)."""
    return sorted({_text(run.option(key)): run.option(key) for run in runs}.values(), key=_rank)


def _arranged(runs: Sequence[Run], keys: Sequence[str]) -> list[list[Run | None]]:
    """Runs in rows and columns."""
    if len(keys) == 2:
        down, across = ([_text(value) for value in _values(runs, key)] for key in keys)
        places = {tuple(_text(run.option(key)) for key in keys): run for run in runs}
        full = len(places) == len(runs) and len(runs) > len(down) * len(across) / 2
        if full and len(across) <= WIDEST:
            return [[places.get((row, column)) for column in across] for row in down]
    ordered: list[Run | None] = [*_ordered(runs, keys)]
    columns = math.ceil(math.sqrt(1.2 * len(ordered)))
    ordered += [None] * (-len(ordered) % columns)
    return [ordered[start : start + columns] for start in range(0, len(ordered), columns)]


def _picture(folder: Path) -> UInt8[np.ndarray, "H W 3"] | None:
    """A run's last render; None where there is none, or none that can be read."""
    try:
        image = read_pixels(folder / "final.png")
    except InputError:
        return None
    height, width = image.shape[:2]
    return area_resize(np.ascontiguousarray(image[..., :3]), *fit_size(width, height, SIDE))


def _sheet(figure: SubFigure, cells: list[list[Run | None]], keys: Sequence[str]) -> None:
    for row, line in zip(figure.subplots(len(cells), len(cells[0]), squeeze=False), cells, strict=True):
        for axes, run in zip(row, line, strict=True):
            axes.set(xticks=[], yticks=[])
            if run is None:
                axes.axis("off")
                continue
            picture = _picture(run.folder)
            if picture is None:
                axes.set_facecolor("#dddddd")
                axes.text(0.5, 0.5, run.status, ha="center", va="center", transform=axes.transAxes, color=VERMILLION)
                axes.set_box_aspect(1)
            else:
                axes.imshow(picture, interpolation="nearest")
            good = run.status in ("finished", "stopped_early")
            told = "no figure" if run.psnr is None else f"{run.psnr:.2f} dB"
            caption = "\n".join(textwrap.wrap(shortened(readable(label(run, keys)), 66), 34))
            axes.set_xlabel(f"{caption}\n{told}" + ("" if good else f", {run.status}"), fontsize=8, parse_math=False)
            if not good:
                axes.xaxis.label.set_color(VERMILLION)
                for spine in axes.spines.values():
                    spine.set(color=VERMILLION, linewidth=3)


def _curves(axes: Axes, runs: Sequence[Run], keys: Sequence[str]) -> None:
    """PSNR over steps, or over seconds where the runs took different numbers of steps."""
    by_steps = len({run.figure("steps") for run in runs if run.status in FINISHED}) <= 1
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, max(len(runs), 1)))
    for run, colour in zip(_ordered(runs, keys), colours, strict=True):
        points = [(p[1] if by_steps else p[0], p[2]) for p in run.curve]
        if points:
            style = "-" if run.status != "collapsed" else ":"
            axes.plot(*zip(*points, strict=True), style, color=colour, label=readable(label(run, keys)), linewidth=1.5)
    axes.set(xlabel="step" if by_steps else "training seconds", ylabel="PSNR, dB", xscale="log")
    axes.grid(alpha=0.3, which="both")
    if 0 < len(axes.lines) <= 12:
        axes.legend(fontsize=7)


def _by_option(axes: Axes, runs: Sequence[Run], keys: Sequence[str]) -> None:
    """Final PSNR by the option with most values; a line for each setting of the others."""
    main = max(keys, key=lambda key: len(_values(runs, key)))
    others = [key for key in keys if key != main]
    values = _values(runs, main)
    numeric = all(_rank(value)[0] == 0 for value in values)
    places = values if numeric else list(range(len(values)))
    at = {_text(value): place for value, place in zip(values, places, strict=True)}
    groups: dict[str, list[Run]] = {}
    for run in _ordered(runs, others):
        groups.setdefault(label(run, others) if others else "", []).append(run)
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(groups))) if others else [BLUE]
    for (name, group), colour in zip(groups.items(), colours, strict=True):
        points = sorted((at[_text(run.option(main))], run.psnr) for run in group if run.psnr is not None)
        if points:
            line = "o-" if len(groups) < 12 else "o"
            axes.plot(*zip(*points, strict=True), line, color=colour, label=readable(name), markersize=5)
    lost = [
        (at[_text(run.option(main))], run.psnr) for run in runs if run.status == "collapsed" and run.psnr is not None
    ]
    if lost:
        axes.plot(*zip(*lost, strict=True), "X", color=VERMILLION, markersize=11, label="collapsed")
    missing = [at[_text(run.option(main))] for run in runs if run.psnr is None]
    for place in missing:
        axes.axvline(place, color=GREY, linestyle="--", linewidth=1)
    if numeric and min(values) > 0 and max(values) / min(values) >= 30:
        axes.set_xscale("log")
    elif not numeric:
        axes.set_xticks(places, [shortened(readable(_text(value)), 24) for value in values], parse_math=False)
    axes.set(xlabel=readable(main), ylabel="final PSNR, dB")
    axes.grid(alpha=0.3)
    if ((others and len(groups) <= 12) or lost) and axes.lines:
        axes.legend(fontsize=7)


def _trouble(run: Run, keys: Sequence[str]) -> str:
    return f"{label(run, keys)}: {run.status}: {run.diagnosis}"
