"""What an image file says before its pixels: size, alpha and EXIF tags, read once a file."""

import importlib.util
import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

MAX_HEADERS = 4096
"""Files whose headers are kept in memory."""
JPEG = b"\xff\xd8"
ORIENTATION, DETAILS, EXPOSURE, APERTURE, SPEED = 0x0112, 0x8769, 0x829A, 0x829D, 0x8827
"""Numbers of EXIF tags: how the camera was held, those about how a photo was taken, seconds, f-number and ISO speed."""
QUARTER_TURNS = (5, 6, 7, 8)
"""Orientations of photos that lie on their side."""
DAMAGED = (OSError, ValueError, SyntaxError, KeyError, TypeError, OverflowError, ZeroDivisionError, struct.error)
"""What Pillow raises for broken tags, or for a picture of a kind that it does not know."""


@dataclass(frozen=True)
class Header:
    """Of one image file."""

    width: int
    """As stored, in pixels."""
    height: int
    alpha: bool
    tags: Mapping[int, Any]
    """EXIF tags by their numbers, but for those of raw bytes, as makers' notes; none where there are none, or broken ones."""

    @property
    def orientation(self) -> int:
        """EXIF orientation, 1 for upright as stored."""
        found = self.tags.get(ORIENTATION, 1)
        return found if isinstance(found, int) else 1


def read_header(path: Path) -> Header | None:
    """The header of an image file; None where Pillow does not know it.

    Raises:
        OSError: there is no such file.
    """
    stat = path.stat()
    return _read_header(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=MAX_HEADERS)
def _read_header(path: Path, size: int, mtime_ns: int) -> Header | None:
    """The other arguments tell versions of a file apart."""
    if importlib.util.find_spec("pillow_heif"):
        import pillow_heif

        pillow_heif.register_heif_opener()
    try:
        with warnings.catch_warnings(), path.open("rb") as file:
            warnings.simplefilter("ignore")  # of sizes: nothing is decoded here; and on tags that nothing asks for
            jpeg = file.read(2) == JPEG
            file.seek(0)
            # Image.open refuses photos of 200 megapixels as bombs.
            with JpegImageFile(file) if jpeg else Image.open(file) as image:
                alpha = "A" in image.getbands() or "transparency" in image.info
                return Header(*image.size, alpha, _read_tags(image))
    except (*DAMAGED, Image.DecompressionBombError):
        return None


def _read_tags(image: Image.Image) -> dict[int, Any]:
    try:
        exif = image.getexif()
        tags = {**exif, **exif.get_ifd(DETAILS)}
        return {tag: value for tag, value in tags.items() if not isinstance(value, bytes)}
    except DAMAGED:
        return {}


def stated_exposure(path: Path) -> float | None:
    """Light that a photo gathered, by its tags: seconds times ISO speed over the squared f-number; None if they do not say."""
    header = read_header(path)
    tags = {} if header is None else header.tags
    try:
        speed = tags[SPEED]
        first = speed[0] if isinstance(speed, tuple) else speed  # of two kinds of sensitivity
        found = float(tags[EXPOSURE]) * float(first) / float(tags[APERTURE]) ** 2
    except (*DAMAGED, IndexError):
        return None
    return found if 0 < found < math.inf else None
