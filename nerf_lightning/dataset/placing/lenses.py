"""Which photos were taken through the same lens, and what they tell about it (EXIF)."""

import math
import tempfile
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from nerf_lightning.dataset.formats.header import DAMAGED, DETAILS, read_header

MAKE, MODEL, FOCAL, FOCAL_35MM = 0x010F, 0x0110, 0x920A, 0xA405
"""Numbers of EXIF tags."""
DIAGONAL_35MM = math.hypot(36, 24)
"""Of a 35 mm film's picture in millimetres: equivalent focal lengths are about pictures of the same diagonal (CIPA DCG-001)."""
PLAUSIBLE = 0.1, 10.0
"""Focal lengths in longest sides; COLMAP takes no others."""


@dataclass(frozen=True)
class Shot:
    """What photos have in common that share a lens and its zoom."""

    width: int
    """Of the upright photo, pixels."""
    height: int
    make: str = ""
    """Of the camera."""
    model: str = ""
    focal: float = 0.0
    """Focal length in millimetres, 0 where the photo does not say."""
    focal_35mm: float = 0.0
    """The same for a 35 mm film."""


def shot(path: Path, width: int, height: int) -> Shot:
    """Reads the EXIF tags of a photo; where there are none, or broken ones, nothing is known but the size.

    Args:
        path: of the photo.
        width, height: of the upright photo, pixels.
    """
    header = read_header(path)
    tags = {} if header is None else header.tags
    make, model = (" ".join(str(tags.get(tag, "")).replace("\0", " ").split()) for tag in (MAKE, MODEL))
    return Shot(width, height, make, model, _millimetres(tags.get(FOCAL)), _millimetres(tags.get(FOCAL_35MM)))


def focal_pixels(shot: Shot) -> float | None:
    """The focal length in pixels that photos tell of; None where they do not."""
    if shot.focal_35mm > 0:
        pixels: float | None = shot.focal_35mm / DIAGONAL_35MM * math.hypot(shot.width, shot.height)
    else:
        pixels = _of_known_sensor(shot) if shot.focal > 0 and shot.model else None
    longest = max(shot.width, shot.height)
    return pixels if pixels and PLAUSIBLE[0] <= pixels / longest <= PLAUSIBLE[1] else None


def _of_known_sensor(shot: Shot) -> float | None:
    """COLMAP knows the sensors of many cameras, but takes the tags from a file: a blank one says the same."""
    import pycolmap

    exif = Image.Exif()
    exif[MAKE], exif[MODEL] = shot.make, shot.model
    exif.get_ifd(DETAILS)[FOCAL] = IFDRational(Fraction(shot.focal).limit_denominator(1000))
    with tempfile.TemporaryDirectory() as folder:
        blank = Path(folder) / "blank.jpg"
        Image.new("L", (shot.width, shot.height)).save(blank, exif=exif.tobytes())
        camera = pycolmap.infer_camera_from_image(blank)
    return float(camera.mean_focal_length()) if camera.has_prior_focal_length else None


def _millimetres(value: Any) -> float:
    try:
        number = float(value)
    except DAMAGED:
        return 0.0
    return number if 0 < number < math.inf else 0.0
