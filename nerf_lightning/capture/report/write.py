"""The report of a capture: three pictures that show whether to trust it."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from nerf_lightning.capture.poses.bundle import LENS_PARAMETERS, lens_vector
from nerf_lightning.capture.poses.calibrate import Calibration
from nerf_lightning.capture.poses.geometry import move
from nerf_lightning.capture.poses.solve import PlacedPhoto
from nerf_lightning.capture.report.contact_sheet import subsample_photos, tag_sheet
from nerf_lightning.capture.run import Capture
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.drawing.camera_map import camera_map
from nerf_lightning.drawing.ink import (
    BLUE,
    DPI,
    FONT,
    SKY,
    VERMILLION,
    as_picture,
    magnification,
    pixels_of,
    readable,
    shortened,
)
from nerf_lightning.drawing.panels import write_png

MAX_NAMES = 60
"""Photos whose names fit below the bars."""


def write_report(capture: Capture, folder: Path) -> list[Path]:
    """Writes the pictures to look at after a capture.

    - `tags.png`: the photos of both folders with their tags, and why some were left out;
    - `errors.png`: the reprojection error by photo, where in the picture corners were seen and how they are off, and the lens;
    - `cameras.png`: the cameras, the tags, the box and the orbit of the scene, from above and from the side.

    Returns:
        The files, in this order.

    Raises:
        InputError: a photo can no longer be read: all are read again.
    """
    lens = capture.calibration.lens
    folders = {"calibration": capture.calibration.photos, "photos": capture.photos}
    numbered = [(number, photo.c2w) for number, photo in enumerate(capture.photos, 1) if photo.c2w is not None]
    figures = {
        "tags": tag_sheet(folders, lens.width / lens.height),
        "errors": pixels_of(error_chart(folders, capture.calibration)),
        "cameras": pixels_of(camera_map(numbered, capture.scene, tag_corners(capture), "metres")),
    }
    files = [folder / f"{name}.png" for name in figures]
    for figure, file in zip(figures.values(), files, strict=True):
        write_png(file, figure)
    return files


def tag_corners(capture: Capture) -> dict[int, Float[np.ndarray, "M 3"]]:
    """Corners in the world of the tags that placed photos show, by id; metres."""
    points = {tag: mark.points for photo in capture.photos for tag, mark in photo.sighting.marks.items()}
    return {tag: move(pose, points[tag]) for tag, pose in capture.solved.tags.items() if tag in points}


def error_chart(folders: Mapping[str, Sequence[PlacedPhoto]], found: Calibration) -> Figure:
    """For each folder, the error of every photo, and the residuals of all corners by their place in the picture, with the hull
    of all corners; below, the lens."""
    figure = Figure(figsize=(18, 6.5 * len(folders)), dpi=DPI, layout="constrained")
    grid = figure.subplots(len(folders), 2, squeeze=False, width_ratios=(1.15, 1))
    for (left, right), (title, photos) in zip(grid, folders.items(), strict=True):
        _draw_bars(left, title, photos)
        _draw_residuals(right, title, photos, found.lens)
    figure.supxlabel(describe_lens(found), fontsize=12)
    return figure


def _draw_bars(axes: Axes, title: str, photos: Sequence[PlacedPhoto]) -> None:
    errors = {number: photo.reprojection_px or 0.0 for number, photo in enumerate(photos, 1) if not photo.reason}
    left_out = [number for number, photo in enumerate(photos, 1) if photo.reason]
    axes.bar(list(errors), list(errors.values()), color=BLUE)
    median = float(np.median(list(errors.values())))
    axes.axhline(median, color="black", linestyle="--", linewidth=1, label=f"median {median:.2f} px")
    if left_out:
        axes.plot(left_out, [0] * len(left_out), "X", color=VERMILLION, markersize=10, clip_on=False, label="left out")
    named = subsample_photos(photos, MAX_NAMES)
    labels = [f"{shortened(readable(photos[i].name), 24)}  {i + 1}" for i in named]
    axes.set_xticks([i + 1 for i in named], labels, rotation=90, fontsize=9, fontfamily=FONT, parse_math=False)
    axes.set_xlim(0.3, len(photos) + 0.7)
    axes.set(title=f"{title}: reprojection error", ylabel="rms of a photo, pixels")
    axes.margins(y=0.12)
    axes.legend(loc="upper right", framealpha=0.9)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_residuals(axes: Axes, title: str, photos: Sequence[PlacedPhoto], lens: Intrinsics) -> None:
    as_picture(axes, lens.width, lens.height)
    seen, residuals = collect_residuals(photos)
    hull = cv2.convexHull(seen.astype(np.float32)).reshape(-1, 2)
    axes.add_patch(Polygon(hull, facecolor=SKY, alpha=0.15, edgecolor="none"))
    longest = float(np.percentile(np.linalg.norm(residuals, axis=1), 90))
    scale = magnification(longest, 0.06 * max(lens.width, lens.height))
    axes.quiver(*seen.T, *(scale * residuals).T, angles="xy", scale_units="xy", scale=1, color=BLUE, width=0.0016)
    covered = cv2.contourArea(hull) / (lens.width * lens.height)
    text = (
        f"{title}: residuals of {len(seen)} corners, {scale:g} times as long; they cover {covered:.0%} of the picture"
    )
    axes.set_title(text)


def collect_residuals(photos: Sequence[PlacedPhoto]) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]:
    """Where all corners of photos that were used were seen, and projected minus seen; pixels."""
    used = [(photo.sighting.marks[tag].pixels, rest) for photo in photos for tag, rest in photo.residuals.items()]
    seen, residuals = zip(*used, strict=True)
    return np.concatenate(seen), np.concatenate(residuals)


def describe_lens(found: Calibration) -> str:
    """The lens in numbers, each with its standard deviation if it was set free."""
    values = dict(zip(LENS_PARAMETERS, lens_vector(found.lens), strict=True))
    free = [f"{name} {values[name]:.5g} ± {deviation:.2g}" for name, deviation in found.deviations.items()]
    fixed = [name for name in LENS_PARAMETERS if name not in found.deviations]
    return "set free:  " + ",   ".join(free) + (f";   kept plain: {', '.join(fixed)}" if fixed else "")
