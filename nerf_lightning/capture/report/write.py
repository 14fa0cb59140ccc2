"""The report of a capture: four pictures that show whether to trust it."""

from pathlib import Path

import imageio.v3 as imageio
from matplotlib.figure import Figure

from nerf_lightning.capture.outcome import calibration_outcomes, photo_outcomes
from nerf_lightning.capture.outputs import Placed
from nerf_lightning.capture.report.camera_map import camera_map, tag_corners
from nerf_lightning.capture.report.contact_sheet import contact_sheet
from nerf_lightning.capture.report.coverage_chart import coverage_chart
from nerf_lightning.capture.report.error_chart import error_chart
from nerf_lightning.capture.run import Capture
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.utils.files import atomic


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
    figures = {
        "tags": contact_sheet(folders, lens.width / lens.height),
        "errors": error_chart(folders, lens),
        "coverage": coverage_chart(capture.calibration),
        "cameras": camera_map(capture.photos, capture.scene, tag_corners(capture)),
    }
    return [_write(figure, folder / f"{name}.png") for name, figure in figures.items()]


def draw_cameras(photos: list[Placed], scene: Scene, folder: Path) -> Path:
    """Writes `cameras.png` alone, for a capture without tags."""
    return _write(camera_map(photos, scene, {}), folder / "cameras.png")


def _write(figure: Figure, file: Path) -> Path:
    with atomic(file) as temporary:
        imageio.imwrite(temporary, pixels_of(figure))
    return file
