"""Which way photos are turned: as their pixels are stored, or as their EXIF data say."""

import logging
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.dataset.formats.decode import image_header, read_header

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
    turned, ambiguous = [], []
    for photo, size in zip(photos, stated, strict=True):
        stored, upright = (image_header(photo, turn)[:2] for turn in (False, True))
        if read_header(photo).orientation == 1 or orientation == "stored":
            continue
        fits_stored, fits_upright = (size is None or has_shape(shape, size) for shape in (stored, upright))
        if orientation == "exif" or (fits_upright and not fits_stored):
            turned.append(photo)
        elif fits_upright:
            ambiguous.append(photo)
    if turned:
        text = "%s: %d photos are turned as their EXIF orientation says, %s first: so they fit their cameras"
        log.warning(text, where, len(turned), turned[0].name)
    if ambiguous:
        text = (
            "%s: %d photos have an EXIF orientation, %s first; their cameras are taken to be about the pixels as stored"
            " (dataset.orientation=exif: about the turned photos)"
        )
        log.warning(text, where, len(ambiguous), ambiguous[0].name)
    chosen = set(turned)
    return [photo in chosen for photo in photos]


def has_shape(size: tuple[float, float], stated: tuple[float, float]) -> bool:
    """Whether a photo of one size may be that of another size, enlarged or reduced."""
    (width, height), (other_width, other_height) = size, stated
    off = max(abs(other_width * height / other_height - width), abs(other_height * width / other_width - height))
    return off <= MAX_ROUNDING_PX
