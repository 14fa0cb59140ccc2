"""The report of a capture: three pictures that show whether to trust it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import move
from nerf_lightning.capture.report.charts import error_chart
from nerf_lightning.capture.report.contact_sheet import tag_sheet
from nerf_lightning.capture.run import Capture
from nerf_lightning.drawing.camera_map import camera_map
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.drawing.panels import write_png


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
