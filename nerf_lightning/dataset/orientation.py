"""Which way photos are turned: as their pixels are stored, or as their EXIF data say."""

import logging
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.dataset.formats.image_files import read_header, read_image_size

log = logging.getLogger(__name__)

MAX_ROUNDING_PX = 1.5
"""By how much a side may differ from that of the same photo at another size: sides are rounded to whole pixels."""
Size = tuple[int, int]
"""Width and height in pixels."""


def choose_orientations(
    where: object, photos: Sequence[Path], stated: Sequence[Size | None], orientation: str
) -> list[bool]:
    """Chooses for each photo whether its camera is about the photo as EXIF turns it, instead of the pixels as stored.

    `auto` takes the stored pixels where they have the shape that the file states for the camera, or where it states none; else
    the turned photo where that has the shape. A line says what was taken.

    Args:
        where: the scene's file, for messages.
        photos: their files.
        stated: sizes of their cameras, of this size or another.
        orientation: "auto", "stored" or "exif"."""
    chosen: list[bool] = []
    others = 0
    for photo, size in zip(photos, stated, strict=True):
        shapes = [read_image_size(photo, turn)[:2] for turn in (False, True)]
        has_turn = read_header(photo).orientation != 1
        fits_stored, fits_upright = (size is None or has_same_aspect(shape, size) for shape in shapes)
        chosen.append(has_turn and (orientation == "exif" or (orientation == "auto" and fits_upright > fits_stored)))
        others += has_turn and orientation == "auto" and fits_upright and fits_stored
    turned = "%s: %d photos are turned as their EXIF orientation says, so that they fit their cameras"
    stored = (
        "%s: %d photos have an EXIF orientation, and are taken as they are stored (dataset.orientation=exif turns them)"
    )
    for count, text in ((sum(chosen), turned), (others, stored)):
        if count:
            log.warning(text, where, count)
    return chosen


def has_same_aspect(size: tuple[float, float], stated: tuple[float, float]) -> bool:
    """Whether a photo of one size may be that of another size, enlarged or reduced."""
    (width, height), (other_width, other_height) = size, stated
    off = max(abs(other_width * height / other_height - width), abs(other_height * width / other_width - height))
    return off <= MAX_ROUNDING_PX
