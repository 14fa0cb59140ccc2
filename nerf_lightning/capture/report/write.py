"""The report of a capture: four pictures that show whether to trust it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from nerf_lightning.capture.outcome import calibration_outcomes, photo_outcomes
from nerf_lightning.capture.outputs import Placed
from nerf_lightning.capture.poses.geometry import move
from nerf_lightning.capture.report.contact_sheet import tag_sheet
from nerf_lightning.capture.report.coverage_chart import coverage_chart
from nerf_lightning.capture.report.error_chart import error_chart
from nerf_lightning.capture.run import Capture
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.camera_map import camera_map
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.drawing.panels import write_png


def write_report(capture: Capture, folder: Path) -> list[Path]:
    """Writes the pictures to look at after a capture.

    - `tags.png`: the photos of both folders with their tags, and why some were left out;
    - `errors.png`: the reprojection error by photo, and where in the picture corners are off, in which direction;
    - `coverage.png`: where in the picture the calibration saw corners, and the lens's distortion;
    - `cameras.png`: the cameras, the tags, the box and the orbit of the scene, from above and from the side.

    Returns:
        The files, in this order.

    Raises:
        InputError: a photo can no longer be read: all are read again.
    """
    lens = capture.calibration.lens
    folders = {"calibration": calibration_outcomes(capture), "photos": photo_outcomes(capture)}
    pictures = {
        "tags": tag_sheet(folders, lens.width / lens.height),
        "errors": pixels_of(error_chart(folders, lens)),
        "coverage": pixels_of(coverage_chart(capture.calibration)),
        "cameras": pixels_of(camera_map(numbered(capture.photos), capture.scene, tag_corners(capture), "metres")),
    }
    return [_write(picture, folder / f"{name}.png") for name, picture in pictures.items()]


def draw_cameras(photos: list[Placed], scene: Scene, folder: Path) -> Path:
    """Writes `cameras.png` alone, for a capture without tags."""
    return _write(pixels_of(camera_map(numbered(photos), scene, {})), folder / "cameras.png")


def tag_corners(capture: Capture) -> dict[int, Float[np.ndarray, "M 3"]]:
    """Corners in the world of the tags that placed photos show, by id; metres."""
    points = {tag: mark.points for sighting in capture.sightings for tag, mark in sighting.marks.items()}
    return {tag: move(pose, points[tag]) for tag, pose in capture.solved.tags.items() if tag in points}


def numbered(photos: Sequence[Placed]) -> list[tuple[int, Float[np.ndarray, "4 4"]]]:
    """The placed photos' numbers and poses."""
    return [(number, photo.c2w) for number, photo in enumerate(photos, 1) if photo.c2w is not None]


def _write(picture: UInt8[np.ndarray, "H W 3"], file: Path) -> Path:
    write_png(file, picture)
    return file
