"""How well the solved cameras fit the photos: the error by photo, and the residuals by place in the picture."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nerf_lightning.capture.outcome import Outcome, thinned
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.drawing.ink import BLUE, DPI, FONT, SKY, VERMILLION, as_picture, magnification, readable, shortened

NAMES = 60
"""Most photos whose names fit below the bars."""
CELLS = 12, 9
"""Cells for mean residuals, along the longer and the shorter side of the picture."""
FEWEST = 4
"""Corners a cell must hold for its mean to be shown."""


def error_chart(folders: Mapping[str, Sequence[Outcome]], lens: Lens) -> Figure:
    """For each folder, the error of every photo, and the residuals of all corners by their place in the picture."""
    figure = Figure(figsize=(18, 6.5 * len(folders)), dpi=DPI, layout="constrained")
    grid = figure.subplots(len(folders), 2, squeeze=False, width_ratios=(1.15, 1))
    for (left, right), (title, outcomes) in zip(grid, folders.items(), strict=True):
        _bars(left, title, outcomes)
        _residuals(right, title, outcomes, lens)
    return figure


def _bars(axes: Axes, title: str, outcomes: Sequence[Outcome]) -> None:
    kept = [o for o in outcomes if not o.reason]
    left_out = [o.number for o in outcomes if o.reason]
    errors = [o.error or 0.0 for o in kept]
    axes.bar([o.number for o in kept], errors, color=BLUE)
    if errors:
        median = float(np.median(errors))
        axes.axhline(median, color="black", linestyle="--", linewidth=1, label=f"median {median:.2f} px")
    if left_out:
        axes.plot(left_out, [0] * len(left_out), "X", color=VERMILLION, markersize=10, clip_on=False, label="left out")
    named = thinned(outcomes, NAMES)
    labels = [f"{shortened(readable(o.path.name), 24)}  {o.number}" for o in named]
    axes.set_xticks([o.number for o in named], labels, rotation=90, fontsize=9, fontfamily=FONT, parse_math=False)
    for tick, outcome in zip(axes.get_xticklabels(), named, strict=True):
        tick.set_color(VERMILLION if outcome.reason else "black")
    axes.set_xlim(0.3, len(outcomes) + 0.7)
    axes.set_title(f"{title}: reprojection error")
    axes.set_ylabel("rms of a photo, pixels")
    axes.margins(y=0.12)
    axes.legend(loc="upper right", framealpha=0.9)
    axes.spines[["top", "right"]].set_visible(False)


def _residuals(axes: Axes, title: str, outcomes: Sequence[Outcome], lens: Lens) -> None:
    """Thin arrows for corners, thick ones for the means of neighbours: there noise cancels, a lens error does not."""
    as_picture(axes, lens.width, lens.height)
    seen, rest = corners_and_residuals(outcomes)
    if not len(seen):
        return
    lengths = np.linalg.norm(rest, axis=1)
    larger = magnification(float(np.percentile(lengths, 90)), 0.06 * max(lens.width, lens.height))
    _arrows(axes, seen, rest * larger, SKY, 0.0016)
    middles, means = cell_means(seen, rest, lens.width, lens.height)
    _arrows(axes, middles, means * larger, VERMILLION, 0.0045)
    axes.set_title(
        f"{title}: residuals of {len(seen)} corners, {larger:g} times as long;\nthick: means of neighbouring corners"
    )


def _arrows(axes: Axes, at: Float[np.ndarray, "M 2"], by: Float[np.ndarray, "M 2"], colour: str, width: float) -> None:
    if len(at):
        axes.quiver(*at.T, *by.T, angles="xy", scale_units="xy", scale=1, color=colour, width=width)


def corners_and_residuals(outcomes: Sequence[Outcome]) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]:
    """Where all corners of photos that were used were seen, and projected minus seen; pixels."""
    pairs = [(o.marks[tag].pixels, rest) for o in outcomes if not o.reason for tag, rest in o.residuals.items()]
    if not pairs:
        return np.zeros((0, 2)), np.zeros((0, 2))
    seen, rest = zip(*pairs, strict=True)
    return np.concatenate(seen), np.concatenate(rest)


def cell_means(
    seen: Float[np.ndarray, "M 2"], rest: Float[np.ndarray, "M 2"], width: int, height: int
) -> tuple[Float[np.ndarray, "C 2"], Float[np.ndarray, "C 2"]]:
    """Means of positions and residuals over the cells of the picture that hold enough corners."""
    cells = np.array(CELLS if width >= height else CELLS[::-1])
    col, row = np.clip(seen / [width, height] * cells, 0, cells - 1).astype(int).T
    cell = row * cells[0] + col
    full = [n for n in np.unique(cell) if (cell == n).sum() >= FEWEST]
    places = np.array([seen[cell == n].mean(0) for n in full]).reshape(-1, 2)
    return places, np.array([rest[cell == n].mean(0) for n in full]).reshape(-1, 2)
