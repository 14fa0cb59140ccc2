"""How well the solved cameras fit the photos: the error by photo, and the residuals by place in the picture."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from nerf_lightning.capture.photo_status import PhotoStatus, subsample_photos
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.drawing.ink import BLUE, DPI, FONT, SKY, VERMILLION, as_picture, magnification, readable, shortened

MAX_NAMES = 60
"""Photos whose names fit below the bars."""


def error_chart(folders: Mapping[str, Sequence[PhotoStatus]], lens: Intrinsics) -> Figure:
    """For each folder, the error of every photo, and the residuals of all corners by their place in the picture."""
    figure = Figure(figsize=(18, 6.5 * len(folders)), dpi=DPI, layout="constrained")
    grid = figure.subplots(len(folders), 2, squeeze=False, width_ratios=(1.15, 1))
    for (left, right), (title, statuses) in zip(grid, folders.items(), strict=True):
        _draw_bars(left, title, statuses)
        _draw_residuals(right, title, statuses, lens)
    return figure


def _draw_bars(axes: Axes, title: str, statuses: Sequence[PhotoStatus]) -> None:
    kept = [s for s in statuses if not s.reason]
    left_out = [s.number for s in statuses if s.reason]
    errors = [s.error or 0.0 for s in kept]
    axes.bar([s.number for s in kept], errors, color=BLUE)
    if errors:
        median = float(np.median(errors))
        axes.axhline(median, color="black", linestyle="--", linewidth=1, label=f"median {median:.2f} px")
    if left_out:
        axes.plot(left_out, [0] * len(left_out), "X", color=VERMILLION, markersize=10, clip_on=False, label="left out")
    named = subsample_photos(statuses, MAX_NAMES)
    labels = [f"{shortened(readable(s.path.name), 24)}  {s.number}" for s in named]
    axes.set_xticks([s.number for s in named], labels, rotation=90, fontsize=9, fontfamily=FONT, parse_math=False)
    axes.set_xlim(0.3, len(statuses) + 0.7)
    axes.set_title(f"{title}: reprojection error")
    axes.set_ylabel("rms of a photo, pixels")
    axes.margins(y=0.12)
    axes.legend(loc="upper right", framealpha=0.9)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_residuals(axes: Axes, title: str, statuses: Sequence[PhotoStatus], lens: Intrinsics) -> None:
    as_picture(axes, lens.width, lens.height)
    seen, residuals = collect_residuals(statuses)
    if not len(seen):
        return
    lengths = np.linalg.norm(residuals, axis=1)
    scale = magnification(float(np.percentile(lengths, 90)), 0.06 * max(lens.width, lens.height))
    axes.quiver(*seen.T, *(scale * residuals).T, angles="xy", scale_units="xy", scale=1, color=SKY, width=0.0016)
    axes.set_title(f"{title}: residuals of {len(seen)} corners, {scale:g} times as long")


def collect_residuals(statuses: Sequence[PhotoStatus]) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]:
    """Where all corners of photos that were used were seen, and projected minus seen; pixels."""
    used = [(s.marks[tag].pixels, rest) for s in statuses if not s.reason for tag, rest in s.residuals.items()]
    seen, residuals = zip(*used, strict=True) if used else ([np.zeros((0, 2))], [np.zeros((0, 2))])
    return np.concatenate(seen), np.concatenate(residuals)
