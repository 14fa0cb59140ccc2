"""The report of a capture: contact sheet, reprojection errors and camera map."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon

from nerf_lightning.capture.pipeline import Capture
from nerf_lightning.capture.poses.bundle_adjustment import LENS_PARAMETERS, lens_to_vector
from nerf_lightning.capture.poses.calibrate import Calibration
from nerf_lightning.capture.poses.geometry import apply_pose
from nerf_lightning.capture.poses.pose_solver import RegisteredPhoto
from nerf_lightning.capture.report.tag_sheet import draw_tag_sheet, subsample_photos
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.drawing import style
from nerf_lightning.drawing.camera_map import plot_camera_map
from nerf_lightning.drawing.panels import write_png

MAX_LABELS = 60
"""Photos whose names fit below the bars."""


def write_report(capture: Capture, folder: Path) -> list[Path]:
    """Writes the figures of a capture and returns their paths.

    - `tags.png`: the photos of both folders with their tags, and why some were excluded;
    - `errors.png`: reprojection errors by photo, residuals over the image plane, and the lens parameters;
    - `cameras.png`: cameras, tags, box and orbit of the scene, from above and from the side.

    Raises:
        InputError: a photo can no longer be read (all are read again).
    """
    lens = capture.calibration.lens
    folders = {"calibration": capture.calibration.photos, "photos": capture.photos}
    numbered = [(number, photo.c2w) for number, photo in enumerate(capture.photos, 1) if photo.c2w is not None]
    tags = collect_tag_corners(capture)
    figures = {
        "tags": draw_tag_sheet(folders, lens.width / lens.height),
        "errors": style.rasterize_figure(plot_errors(folders, capture.calibration)),
        "cameras": style.rasterize_figure(plot_camera_map(numbered, capture.scene, tags, "meters")),
    }
    files = [folder / f"{name}.png" for name in figures]
    for figure, file in zip(figures.values(), files, strict=True):
        write_png(file, figure)
    return files


def collect_tag_corners(capture: Capture) -> dict[int, Float[np.ndarray, "M 3"]]:
    """World positions of the tags' corners, meters, by tag id."""
    points = {tag: corners.points for photo in capture.photos for tag, corners in photo.observation.detections.items()}
    return {tag: apply_pose(pose, points[tag]) for tag, pose in capture.solution.tags.items() if tag in points}


def plot_errors(folders: Mapping[str, Sequence[RegisteredPhoto]], calibration: Calibration) -> Figure:
    """Plots each folder's reprojection errors by photo and its residuals over the image plane; below, the lens parameters."""
    figure = Figure(figsize=(18, 6.5 * len(folders)), dpi=style.DPI, layout="constrained")
    grid = figure.subplots(len(folders), 2, squeeze=False, width_ratios=(1.15, 1))
    for (left, right), (title, photos) in zip(grid, folders.items(), strict=True):
        _draw_bars(left, title, photos)
        _draw_residuals(right, title, photos, calibration.lens)
    figure.supxlabel(describe_lens(calibration), fontsize=12)
    return figure


def _draw_bars(axes: Axes, title: str, photos: Sequence[RegisteredPhoto]) -> None:
    errors = {number: photo.reprojection_px or 0.0 for number, photo in enumerate(photos, 1) if not photo.reason}
    excluded = [number for number, photo in enumerate(photos, 1) if photo.reason]
    axes.bar(list(errors), list(errors.values()), color=style.BLUE)
    median = float(np.median(list(errors.values())))
    axes.axhline(median, color="black", linestyle="--", linewidth=1, label=f"median {median:.2f} px")
    if excluded:
        zeros = [0] * len(excluded)
        axes.plot(excluded, zeros, "X", color=style.VERMILLION, markersize=10, clip_on=False, label="excluded")
    labeled = subsample_photos(photos, MAX_LABELS)
    labels = [f"{style.shorten(style.replace_missing_glyphs(photos[i].name), 24)}  {i + 1}" for i in labeled]
    axes.set_xticks([i + 1 for i in labeled], labels, rotation=90, fontsize=9, fontfamily=style.FONT, parse_math=False)
    axes.set_xlim(0.3, len(photos) + 0.7)
    axes.set(title=f"{title}: reprojection error", ylabel="RMS per photo, pixels")
    axes.margins(y=0.12)
    axes.legend(loc="upper right", framealpha=0.9)
    axes.spines[["top", "right"]].set_visible(False)


def _draw_residuals(axes: Axes, title: str, photos: Sequence[RegisteredPhoto], lens: Intrinsics) -> None:
    style.set_image_axes(axes, lens.width, lens.height)
    pixels, residuals = collect_residuals(photos)
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2)
    axes.add_patch(Polygon(hull, facecolor=style.SKY, alpha=0.15, edgecolor="none"))
    typical_length = float(np.percentile(np.linalg.norm(residuals, axis=1), 90))
    scale = style.choose_magnification(typical_length, 0.06 * max(lens.width, lens.height))
    arrows = scale * residuals
    axes.quiver(*pixels.T, *arrows.T, angles="xy", scale_units="xy", scale=1, color=style.BLUE, width=0.0016)
    coverage = cv2.contourArea(hull) / (lens.width * lens.height)
    text = f"{title}: residuals of {len(pixels)} corners, magnified {scale:g} times; they cover {coverage:.0%} of the photo"
    axes.set_title(text)


def collect_residuals(photos: Sequence[RegisteredPhoto]) -> tuple[Float[np.ndarray, "M 2"], Float[np.ndarray, "M 2"]]:
    """Detected corners of all used photos, and their residuals (projected - detected); pixels."""
    used = [(p.observation.detections[tag].pixels, residuals) for p in photos for tag, residuals in p.residuals.items()]
    pixels, residuals = zip(*used, strict=True)
    return np.concatenate(pixels), np.concatenate(residuals)


def describe_lens(calibration: Calibration) -> str:
    """Formats the lens parameters, those that were fitted with their standard deviations."""
    values = dict(zip(LENS_PARAMETERS, lens_to_vector(calibration.lens), strict=True))
    free = [f"{name} {values[name]:.5g} ± {deviation:.2g}" for name, deviation in calibration.deviations.items()]
    fixed = [name for name in LENS_PARAMETERS if name not in calibration.deviations]
    return "fitted:  " + ",   ".join(free) + (f";   fixed: {', '.join(fixed)}" if fixed else "")
