"""What cameras write into their photos."""

import importlib.util
import math
import struct
import warnings
from pathlib import Path
from typing import Any

from PIL import Image

DETAILS, EXPOSURE, APERTURE, SPEED = 0x8769, 0x829A, 0x829D, 0x8827
"""Numbers of EXIF tags: of those about how a photo was taken; among these seconds, f-number and ISO speed."""
DAMAGED = (OSError, ValueError, SyntaxError, KeyError, TypeError, OverflowError, ZeroDivisionError, struct.error)
"""What Pillow raises for broken tags, or for a picture of a kind that it does not know."""


def exif_tags(path: Path) -> dict[int, Any]:
    """The EXIF tags of a photo by their numbers; where there are none, or broken ones, nothing."""
    if importlib.util.find_spec("pillow_heif"):
        import pillow_heif

        pillow_heif.register_heif_opener()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # remarks on tags that nothing here asks for
            with Image.open(path) as image:
                exif = image.getexif()
                return {**exif, **exif.get_ifd(DETAILS)}
    except (*DAMAGED, Image.DecompressionBombError):
        return {}


def stated_exposure(path: Path) -> float | None:
    """Light that a photo gathered, by its tags: seconds times ISO speed over the squared f-number; None if they do not say."""
    tags = exif_tags(path)
    try:
        speed = tags[SPEED]
        first = speed[0] if isinstance(speed, tuple) else speed  # of two kinds of sensitivity
        found = float(tags[EXPOSURE]) * float(first) / float(tags[APERTURE]) ** 2
    except (*DAMAGED, IndexError):
        return None
    return found if 0 < found < math.inf else None
