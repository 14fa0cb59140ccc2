"""The chart: held-out PSNR against seconds of training and of rendering, a row of two panels for each setting."""

import math
import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib.ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nerf_lightning.chart.comparison import COSTS, Comparison, Cost
from nerf_lightning.chart.placement import add_name, place_names
from nerf_lightning.chart.points import Point
from nerf_lightning.chart.references import Reference
from nerf_lightning.drawing.ink import BLUE, DPI, GREEN, GREY, MAUVE, ORANGE, SKY, VERMILLION, readable, shortened

INKS = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (MAUVE, "D"), (SKY, "v"), ("#000000", "P"), ("#B8A000", "X"))
"""Colour and shape of each method; more methods begin again."""
WIDTH, ROW = 12.0, 5.4
"""Inches."""
SHARP = 1.3
"""Times the pixels of other figures: there is much to read."""
LINE = 0.165
"""Inches of a line of small text, at 9 points."""
LETTERS = 160
"""Of such a line."""
MOST_ROWS = 4
"""Settings in a figure; the table has all."""
MOST_TROUBLES = 24
"""Lines of the box; the table has all."""
BEYOND = 30.0
"""How many times the longest training of one's own the axis reaches, where publications took longer."""


def area(size: float | None) -> float:
    """Of a marker, in square points: grows with the square root of the bytes, from 10 kB to 100 MB."""
    return 12.0 + 0.018 * math.sqrt(min(max(size or 0.0, 1e4), 1e8))


def inks(methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Colour and shape by method."""
    return {method: INKS[index % len(INKS)] for index, method in enumerate(sorted(set(methods)))}


def chart_figure(comparisons: Sequence[Comparison], troubles: Sequence[str]) -> Figure:
    """Draws all comparisons, the first on top, with words under each; `troubles` stand in a box at the end.

    In an SVG every marker has the id COST-ROW-NUMBER, by the places of a comparison and of its points, and every published
    one published-ROW-NUMBER.
    """
    shown = comparisons[:MOST_ROWS]
    words = [_words(one) for one in shown]
    box = _box(troubles, len(comparisons) - len(shown))
    heights = [height for lines in words for height in (ROW, LINE * (len(lines) + 1))]
    heights += [LINE * (len(box) + 2)] if box else []
    figure = Figure(figsize=(WIDTH, sum(heights)), dpi=SHARP * DPI, layout="constrained")
    parts: Any = figure.subfigures(len(heights), 1, height_ratios=heights, squeeze=False)[:, 0]
    methods = inks([point.method for one in comparisons for point in one.points])
    for row, (one, lines) in enumerate(zip(shown, words, strict=True)):
        parts[2 * row].suptitle(readable(one.setting.words()), fontsize=11, parse_math=False)
        left, right = parts[2 * row].subplots(1, 2, sharey=True)
        for axes, cost in zip((left, right), COSTS, strict=True):
            _draw(axes, cost, row, one, methods)
        left.set(ylabel="held-out PSNR, dB", ylim=_limits(one))
        entries = _legend(one, methods)
        columns = math.ceil(len(entries) / 2)
        parts[2 * row].legend(handles=entries, loc="outside lower center", ncols=columns, fontsize=8, frameon=False)
        _write(parts[2 * row + 1], lines, "black")
    if box:
        _write(parts[-1], box, VERMILLION)
    figure.draw_without_rendering()
    for axes in figure.axes:
        place_names(axes)
    return figure


def _words(one: Comparison) -> list[str]:
    said = [*one.advice, *one.remarks, *one.provenance]
    return [line for text in said for line in textwrap.wrap(readable(text), LETTERS, subsequent_indent="    ")]


def _box(troubles: Sequence[str], rows_left_out: int) -> list[str]:
    lines = [shortened(readable(text), LETTERS) for text in troubles[:MOST_TROUBLES]]
    if len(troubles) > MOST_TROUBLES:
        lines.append(f"and {len(troubles) - MOST_TROUBLES} more, all in chart.csv")
    if lines:
        lines.insert(0, f"Collapsed, failed or cut short ({len(troubles)}):")
    if rows_left_out:
        lines.append(f"{rows_left_out} more settings with fewer points are in chart.csv")
    return lines


def _write(part: Any, lines: Sequence[str], colour: str) -> None:
    frame = {"boxstyle": "round", "facecolor": "white", "edgecolor": colour} if colour != "black" else None
    text = "\n".join(lines)
    part.text(0.03, 0.5, text, va="center", fontsize=9, color=colour, parse_math=False, bbox=frame, linespacing=1.3)


def _draw(axes: Axes, cost: Cost, row: int, one: Comparison, methods: dict[str, tuple[str, str]]) -> None:
    priced = [(number, point, cost.of(point)) for number, point in enumerate(one.points)]
    placed = [(number, point, price) for number, point, price in priced if price is not None]
    axes.set(xscale="log", xlabel=cost.label)
    axes.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(matplotlib.ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
    axes.grid(alpha=0.25, which="both", linewidth=0.5)
    if not placed:
        axes.text(0.5, 0.5, "not measured", ha="center", va="center", transform=axes.transAxes, color=GREY)
        return
    training, chosen = cost.name == "training", one.frontiers[cost.name]
    # Small markers above large ones, and the frontier above all: what is covered can neither be seen nor pointed at.
    placed.sort(key=lambda one: (one[0] in chosen, -(one[1].size or 0)))
    for number, point, price in placed:
        colour, shape = methods[point.method]
        if training and len(point.typical.curve) > 1:
            seconds, _, quality = zip(*point.typical.curve, strict=True)
            axes.plot(seconds, quality, color=colour, alpha=0.35, linewidth=0.8, zorder=1)
        _seeds(axes, price, point, colour)
        size = area(point.size)
        marker = axes.scatter(
            [price], [point.psnr], size, colour, marker=shape, edgecolor="white", linewidth=0.6, zorder=4
        )
        marker.set_gid(f"{cost.name}-{row}-{number}")
        if point.lost:
            axes.scatter([price], [point.psnr], size + 70, facecolor="none", edgecolor=VERMILLION, zorder=4)
    front = sorted((price, point.psnr, point.label) for number, point, price in placed if number in chosen)
    prices, heights, names = zip(*front, strict=True)
    axes.plot(prices, heights, drawstyle="steps-post", color="black", linewidth=1.1, zorder=3)
    for price, height, name in zip(prices, heights, names, strict=True):
        add_name(axes, name, price, height, "black", 7.5)
    if training:
        _published(axes, row, one.references, BEYOND * max(price for _, _, price in placed))


def _limits(one: Comparison) -> tuple[float, float]:
    """From the lowest to the highest median or publication, in dB, and some room; a bar to a lost seed leaves the picture."""
    heights = [point.psnr for point in one.points] + [reference.psnr for reference in one.references]
    margin = 0.08 * (max(heights) - min(heights)) + 0.5
    return min(heights) - margin, max(heights) + margin


def _seeds(axes: Axes, price: float, point: Point, colour: str) -> None:
    """From the worst seed, which has a bar of its own, to the best; a lost one is far below."""
    if len(point.runs) > 1:
        low = point.worst if math.isfinite(point.worst) else -1e3
        axes.plot([price, price], [low, point.best], color=colour, linewidth=1.2, zorder=2)
        axes.plot([price], [low], marker="_", color=colour, markersize=8, markeredgewidth=1.6, zorder=2)


def _published(axes: Axes, row: int, references: Sequence[Reference], reach: float) -> None:
    """Hollow markers; those beyond the axis stand at its end, with their time."""
    for number, one in enumerate(references):
        inside = one.seconds <= reach
        place, shape = min(one.seconds, reach), "o" if inside else ">"
        marker = axes.scatter([place], [one.psnr], 34, marker=shape, facecolor="none", edgecolor=GREY, zorder=2)
        marker.set_gid(f"published-{row}-{number}")
        add_name(axes, one.name if inside else f"{one.name} ({in_time(one.seconds)})", place, one.psnr, GREY, 7)


def in_time(seconds: float) -> str:
    """45 s, 12 min or 23.6 h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _legend(one: Comparison, methods: dict[str, tuple[str, str]]) -> list[Line2D]:
    def dot(colour: str, shape: str, size: float, label: str, hollow: bool = False) -> Line2D:
        given: dict[str, Any] = {"linestyle": "", "marker": shape, "markersize": math.sqrt(size), "label": label}
        return Line2D([], [], color=colour, markerfacecolor="none" if hollow else colour, **given)

    present = sorted({point.method for point in one.points})
    entries = [dot(*methods[method], 49, readable(method)) for method in present]
    entries += [
        dot("#999999", "o", area(size), label) for size, label in ((1e5, "0.1 MB"), (1e6, "1 MB"), (1e7, "10 MB"))
    ]
    entries.append(Line2D([], [], color="black", linewidth=1.1, label="Pareto frontier"))
    entries.append(Line2D([], [], color=GREY, marker="_", linewidth=1.2, label="worst to best seed"))
    entries.append(Line2D([], [], color=GREY, alpha=0.5, linewidth=0.8, label="PSNR on the way"))
    if one.references:
        entries.append(dot(GREY, "o", 34, "published, other hardware", hollow=True))
    if any(point.lost for point in one.points):
        entries.append(dot(VERMILLION, "o", 90, "some seeds lost", hollow=True))
    return entries
