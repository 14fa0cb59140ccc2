"""The heat map: worst seed's dB and failure rate by condition and method."""

from collections.abc import Sequence

import matplotlib
import matplotlib.patches
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from nerf_lightning.drawing.ink import DPI, GREY, VERMILLION, readable
from nerf_lightning.stability.verdict import Square

LOW, HIGH = 8.0, 34.0
"""dB at the ends of the colours."""


def heatmap(found: Sequence[Square], title: str) -> Figure:
    """A row for each condition, a column for each method; red letters where seeds failed."""
    conditions = list(dict.fromkeys(square.condition.name for square in found))
    methods = list(dict.fromkeys(square.method for square in found))
    figure = Figure(figsize=(3.2 + 1.35 * len(methods), 1.4 + 0.34 * len(conditions)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    colours, scale = matplotlib.colormaps["viridis"], Normalize(LOW, HIGH, clip=True)
    for square in found:
        column, row = methods.index(square.method), conditions.index(square.condition.name)
        worst, lost, seeds = square.worst, len(square.failed), len(square.outcomes)
        if worst is None:
            colour: object = "#e6e6e6"
            told = "refused" if all(one.status == "refused" for one in square.outcomes) else "failed"
        else:
            colour, told = colours(scale(worst)), f"{worst:.1f}"
        if square.condition.hopeless and not lost and worst is not None:
            told += "  alarm"
        elif lost or worst is not None:
            told += f"  {lost}/{seeds}"
        axes.add_patch(
            matplotlib.patches.Rectangle((column - 0.5, row - 0.5), 1, 1, facecolor=colour, edgecolor="white")
        )
        dark = worst is not None and scale(worst) < 0.6
        ink = "#ff9a6b" if lost and dark else VERMILLION if lost else "white" if dark else "black"
        weight = "bold" if lost else "normal"
        axes.text(column, row, told, ha="center", va="center", fontsize=8.5, color=ink, weight=weight)
    axes.set(xlim=(-0.5, len(methods) - 0.5), ylim=(len(conditions) - 0.5, -0.5))
    axes.set_xticks(range(len(methods)), [readable(method) for method in methods], rotation=20, ha="left", fontsize=9)
    axes.xaxis.tick_top()
    axes.set_yticks(range(len(conditions)), [readable(name) for name in conditions], fontsize=9)
    axes.tick_params(length=0)
    axes.set_xlabel(readable(title), color=GREY, fontsize=9)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return figure
