"""Where in the picture a calibration saw corners, and the lens it found."""

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from nerf_lightning.capture.poses.bundle import LENS_PARAMETERS, lens_vector
from nerf_lightning.capture.poses.calibrate import Calibration
from nerf_lightning.capture.poses.geometry import project
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.drawing.ink import BLUE, DPI, SKY, as_picture

UNITS = {"focal": "px", "cx": "px", "cy": "px"}


def coverage_chart(found: Calibration) -> Figure:
    """Where in the picture the calibration saw corners, and how the lens it found bends straight lines."""
    figure = Figure(figsize=(18, 7.5), dpi=DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    lens = found.lens
    as_picture(left, lens.width, lens.height)
    marks = [mark for sighting in found.used for mark in sighting.marks.values()]
    corners = np.concatenate([mark.pixels for mark in marks])
    hull = cv2.convexHull(corners.astype(np.float32)).reshape(-1, 2)
    left.add_patch(Polygon(hull, facecolor=SKY, alpha=0.25, edgecolor="none"))
    left.add_patch(Polygon(hull, facecolor="none", edgecolor=BLUE, linewidth=1.5))
    left.plot(*corners.T, ".", color=BLUE, markersize=5)
    left.set_title(
        f"{len(corners)} corners in {len(found.used)} photos; their hull covers {found.coverage:.0%} of the picture"
    )
    _draw_distortion(figure, right, lens)
    figure.supxlabel(describe_lens(found), fontsize=12)
    return figure


def describe_lens(found: Calibration) -> str:
    """The lens in numbers, each with its standard deviation if it was set free."""
    values = dict(zip(LENS_PARAMETERS, lens_vector(found.lens), strict=True))
    free = []
    for name, spread in found.deviations.items():
        digits = int(np.clip(1 - np.floor(np.log10(max(spread, 1e-9))), 0, 6))  # two of the standard deviation
        free.append(f"{name} {values[name]:.{digits}f} ± {spread:.{digits}f} {UNITS.get(name, '')}".strip())
    fixed = [name for name in LENS_PARAMETERS if name not in found.deviations]
    return "set free:  " + ",   ".join(free) + (f";   kept plain: {', '.join(fixed)}" if fixed else "")


def displacement(lens: Intrinsics, pixels: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    """How far the distortion moves points that a pinhole camera would show at these pixels."""
    rays = (pixels - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    return project(lens, np.eye(4), np.column_stack([rays, np.ones(len(rays))])) - pixels


def _draw_distortion(figure: Figure, axes: Axes, lens: Intrinsics) -> None:
    """How far, and in which direction, the lens moves points."""
    as_picture(axes, lens.width, lens.height)
    x, y = np.meshgrid(np.linspace(0, lens.width, 97), np.linspace(0, lens.height, 73))
    moved = displacement(lens, np.stack([x, y], axis=-1).reshape(-1, 2)).reshape(*x.shape, 2)
    lengths = np.linalg.norm(moved, axis=-1)
    largest = float(lengths.max())
    shades = axes.pcolormesh(x, y, lengths, cmap="cividis", vmin=0, vmax=max(largest, 1e-3), shading="gouraud")
    figure.colorbar(shades, ax=axes, label="displacement by the lens, pixels", shrink=0.8)
    some = np.s_[4::8, 4::8]
    axes.quiver(x[some], y[some], moved[some][..., 0], moved[some][..., 1], angles="xy", color="white", width=0.002)
    axes.set_title(f"distortion moves points by up to {largest:.1f} pixels")
