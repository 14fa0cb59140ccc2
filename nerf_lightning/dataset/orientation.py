"""Photo orientation: as stored, or as rotated by EXIF."""

import logging
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.dataset.formats.image_files import read_header, read_image_size

log = logging.getLogger(__name__)

MAX_ROUNDING_PX = 1.5
"""Largest side difference between copies of a photo at two sizes: sides are rounded to whole pixels."""
Size = tuple[int, int]
"""Width and height in pixels."""


def choose_orientations(
    where: object, photos: Sequence[Path], stated: Sequence[Size | None], orientation: str
) -> list[bool]:
    """Chooses for each photo whether its camera refers to the EXIF-rotated photo (True) or to the stored pixels.

    `auto` takes the stored pixels if their aspect ratio is the camera's, or if the camera states no size; else the rotated
    photo if it matches. The choice is logged.

    Args:
        where: scene file, for messages.
        photos: image files.
        stated: camera sizes, in any resolution.
        orientation: "auto", "stored" or "exif"."""
    chosen: list[bool] = []
    num_ignored = 0
    for photo, size in zip(photos, stated, strict=True):
        shapes = [read_image_size(photo, turn)[:2] for turn in (False, True)]
        is_rotated = read_header(photo).orientation != 1
        fits_stored, fits_upright = (size is None or has_same_aspect(shape, size) for shape in shapes)
        chosen.append(is_rotated and (orientation == "exif" or (orientation == "auto" and fits_upright > fits_stored)))
        num_ignored += is_rotated and orientation == "auto" and fits_upright and fits_stored
    rotated = "%s: %d photos are rotated by their EXIF orientation to match their cameras"
    stored = "%s: EXIF orientation of %d photos ignored, pixels used as stored (dataset.orientation=exif rotates them)"
    for count, text in ((sum(chosen), rotated), (num_ignored, stored)):
        if count:
            log.warning(text, where, count)
    return chosen


def has_same_aspect(size: tuple[float, float], stated: tuple[float, float]) -> bool:
    """Whether two sizes have the same aspect ratio, up to rounding."""
    (width, height), (other_width, other_height) = size, stated
    error = max(abs(other_width * height / other_height - width), abs(other_height * width / other_width - height))
    return error <= MAX_ROUNDING_PX
