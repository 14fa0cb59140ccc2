"""A printable sheet of tags, as PDF."""

from pathlib import Path

import cv2
import numpy as np
from matplotlib.backends.backend_pdf import FigureCanvasPdf
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from nerf_lightning.capture.tags.detect import get_dictionary
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic_write

A4_METERS = 0.210, 0.297
RULER_METERS = 0.1
"""Length of the line that verifies the print scale."""
METERS_PER_INCH = 0.0254


def write_sheet_pdf(layout: TagLayout, file: Path) -> None:
    """Writes a planar layout of tags as a PDF at true scale.

    Raises:
        InputError: the file is not a PDF, or the tags do not fit on the page.
    """
    if file.suffix.lower() != ".pdf":
        raise InputError("print-tags", "sheet", str(file), "a file name that ends in .pdf")
    figure = draw_sheet(layout)
    with atomic_write(file) as temporary:
        FigureCanvasPdf(figure).print_pdf(temporary)


def draw_sheet(layout: TagLayout) -> Figure:
    """Draws a planar layout of tags, centered on an A4 page.

    Raises:
        InputError: the tags do not fit on the page, or are not in the family.
    """
    patterns = get_dictionary(layout.dictionary)
    if (max_id := max(layout.poses)) >= len(patterns.bytesList):
        expected = f"one of the {len(patterns.bytesList)} tags of {layout.dictionary}"
        raise InputError("print-tags", "layout", f"tag {max_id}", expected, "name a larger family with dictionary")
    corners = np.concatenate([layout.corners(tag)[:, :2] for tag in layout.poses])
    low, high = corners.min(0), corners.max(0)
    margin = layout.size / 6
    if (high - low + 2 * margin > A4_METERS).any():
        problem = f"{1000 * (high - low)[0]:.0f} x {1000 * (high - low)[1]:.0f} mm of tags"
        raise InputError("print-tags", "tag_size", problem, "tags that fit an A4 page with a margin", "reduce tag_size")
    width, height = A4_METERS
    figure = Figure(figsize=(width / METERS_PER_INCH, height / METERS_PER_INCH))
    axes = figure.add_axes((0, 0, 1, 1))
    center = (low + high) / 2
    axes.set(xlim=center[0] + np.array([-0.5, 0.5]) * width, ylim=center[1] + np.array([-0.5, 0.5]) * height)
    axes.set_axis_off()
    side = patterns.markerSize + 2
    module = layout.size / side
    for tag, pose in layout.poses.items():
        is_black = cv2.aruco.generateImageMarker(patterns, tag, side) < 128
        rotation = float(np.degrees(np.arctan2(pose[1, 0], pose[0, 0])))
        for row, column in np.argwhere(is_black).tolist():
            local = np.array([column * module - layout.size / 2, (side - 1 - row) * module - layout.size / 2, 0])
            x, y, _ = pose[:3, :3] @ local + pose[:3, 3]
            # The outline hides seams between modules.
            axes.add_patch(Rectangle((x, y), module, module, angle=rotation, color="black", linewidth=0.2))
    text = f"{layout.dictionary}, tags of {100 * layout.size:g} cm. Print without scaling: this line is 10 cm long."
    bottom = center[1] - height / 2 + 0.009
    axes.plot(center[0] + np.array([-0.5, 0.5]) * RULER_METERS, [bottom, bottom], color="black", linewidth=0.8)
    axes.text(center[0], bottom + 0.002, text, ha="center", va="bottom", fontsize=7)
    return figure
