"""Charts of a comparison: PSNR by configuration and against each cost."""

import numpy as np
import pandas as pd
from adjustText import adjust_text
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from nerf_lightning.comparison.points import COSTS, find_median_run, format_bytes
from nerf_lightning.drawing.style import (
    GRAY,
    VERMILLION,
    assign_styles,
    rasterize_figure,
    replace_missing_glyphs,
    shorten,
)

PANEL_WIDTH_IN, PANEL_HEIGHT_IN, DPI = 4.8, 3.5, 172
"""Panel size in inches, and pixels per inch."""
MAX_LABELS = 8
"""Up to this many points, each has a label and color; beyond, only the frontier is labeled and colors mark methods."""
MAX_ROWS = 12
"""Configurations in the quality panel."""
MAX_PUBLISHED_TIME_RATIO = 30.0
"""Upper end of the time axis for publications, relative to the longest training of the runs."""


def draw_panels(points: pd.DataFrame, references: pd.DataFrame) -> list[UInt8[np.ndarray, "_ _ 3"]]:
    """Draws the quality panel, then one per known cost."""
    kind = "label" if len(points) <= MAX_LABELS else "method"
    styles = assign_styles(sorted(points[kind]))
    points = points.assign(style=[styles[name] for name in points[kind]])
    figures = [draw_quality(points)]
    figures += [draw_cost(points, cost, references) for cost in COSTS if len(points) > 1 and points[cost].notna().any()]
    return [rasterize_figure(figure) for figure in figures]


def make_panel(title: str) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(PANEL_WIDTH_IN, PANEL_HEIGHT_IN), dpi=DPI, layout="constrained")
    axes = figure.add_subplot(axisbelow=True)
    axes.set_title(title, loc="left")
    axes.grid(color="0.9", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.15, y=0.12)
    return figure, axes


def draw_quality(points: pd.DataFrame) -> Figure:
    """Plots the PSNR of each configuration, best first: median, and a tick per seed."""
    shown = points.head(MAX_ROWS)
    figure, axes = make_panel("Quality" if len(shown) == len(points) else f"Quality of the best {MAX_ROWS}")
    for row, point in enumerate(shown.itertuples()):
        color, marker = point.style
        seeds = [run.psnr for run in point.runs if run.status != "collapsed"]
        axes.plot(seeds, [row] * len(seeds), "|", color=color, markersize=12)
        axes.plot(point.psnr, row, marker, color=color, markersize=8, markeredgecolor="white")
        axes.annotate(f"{point.psnr:.2f}", (point.psnr_max, row), (8, -3), textcoords="offset points", fontsize=8)
    names = [shorten(replace_missing_glyphs(name), 34) for name in shown["label"]]
    axes.set_yticks(range(len(shown)), names, parse_math=False, fontsize=8.5)
    for tick, collapsed in zip(axes.get_yticklabels(), shown["collapsed"], strict=True):
        tick.set_color(VERMILLION if collapsed else "black")
    axes.set(ylim=(len(shown) - 0.5, -0.7), xlabel="held-out PSNR, dB")
    axes.grid(visible=False, axis="y")
    return figure


def draw_cost(points: pd.DataFrame, cost: str, references: pd.DataFrame) -> Figure:
    """Plots PSNR against a cost: seed range, Pareto frontier and training curves; publications are hollow."""
    figure, axes = make_panel(f"Quality against {COSTS[cost].split(',')[0]}")
    placed, training = points[points[cost].notna()], cost == "train_seconds"
    texts: list[Text] = []
    xs: list[float] = placed[cost].tolist()
    front = placed[[cost in costs.split() for costs in placed["frontier"]]].sort_values([cost, "psnr"])
    for point in placed.itertuples():
        color, marker = point.style
        x = getattr(point, cost)
        edge, low = (VERMILLION, point.psnr) if point.collapsed else ("white", point.psnr_min)
        axes.plot([x, x], [low, point.psnr_max], color=color, linewidth=1.5)
        axes.scatter([x], [point.psnr], 55, color, marker=marker, edgecolor=edge, linewidth=0.6, zorder=4)
        if len(points) <= MAX_LABELS or point.Index in front.index:
            texts.append(add_label(axes, point.label, x, point.psnr, color))
    reach, label = MAX_PUBLISHED_TIME_RATIO * placed[cost].max(), "published, other hardware"
    for one in references.itertuples() if training else ():
        x, inside = min(one.seconds, reach), one.seconds <= reach
        xs.append(x)
        axes.scatter([x], [one.psnr], 34, "none", marker="o" if inside else ">", edgecolor=GRAY, label=label)
        time = f"{one.seconds / 3600:.1f} h" if one.seconds >= 3600 else f"{one.seconds / 60:.0f} min"
        name = one.name if inside else f"{one.name} ({time})"
        texts.append(add_label(axes, name, x, one.psnr, GRAY))
        label = ""
    if training and len(points) <= MAX_LABELS:
        low, high = axes.get_ylim()
        for point in placed.itertuples():
            curve = np.array(find_median_run(point).curve).reshape(-1, 3)
            axes.plot(curve[:, 0], curve[:, 2], color=point.style[0], linewidth=1, alpha=0.5)
        axes.set_ylim(low - 0.3 * (high - low), high)
    if len(front) > 1:
        axes.plot(front[cost], front["psnr"], drawstyle="steps-post", color="0.4", linewidth=1, label="Pareto frontier")
    if len(points) > MAX_LABELS:
        for method, (color, marker) in dict(zip(placed["method"], placed["style"], strict=True)).items():
            axes.plot([], [], marker, color=color, label=replace_missing_glyphs(method))
    axes.set(xlabel=COSTS[cost], ylabel="held-out PSNR, dB")
    scale_costs(axes, cost, xs)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=7, frameon=False, loc="lower right")
    adjust_text(texts, ax=axes, expand=(1.15, 1.5), arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.6})
    return figure


def scale_costs(axes: Axes, cost: str, values: list[float]) -> None:
    """Sets few round ticks, and a log scale if costs differ by more than a factor of 8."""
    ratio = max(values) / min(values)
    if ratio > 8:
        axes.set_xscale("log")
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if ratio < 50 else (1.0,)))
        axes.xaxis.set_minor_formatter(NullFormatter())
    else:
        axes.xaxis.set_major_locator(MaxNLocator(5))
        axes.set_xlim(left=max(0.0, axes.get_xlim()[0]))
    write = format_bytes if cost == "bytes" else "{:g}".format
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: write(value)))


def add_label(axes: Axes, name: str, x: float, y: float, color: str) -> Text:
    text = axes.text(x, y, shorten(replace_missing_glyphs(name), 34), color=color, size=8, zorder=6, parse_math=False)
    text.set_path_effects([withStroke(linewidth=2, foreground="white")])
    return text
