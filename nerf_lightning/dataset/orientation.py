"""Which way photos are turned: as their pixels are stored, or as their EXIF data say."""

import logging
from pathlib import Path

from nerf_lightning.dataset.formats.decode import image_header
from nerf_lightning.dataset.formats.header import read_header

log = logging.getLogger(__name__)

MAX_ROUNDING_PX = 1.5
"""By how much a side may differ from that of the same photo at another size: sides are rounded to whole pixels."""


class OrientationChooser:
    """Chooses for each photo whether its camera is about the stored pixels or about the photo as EXIF turns it.

    `auto` takes the stored pixels where they have the shape that the file states for the camera, or where it states none; else
    the turned photo where that has the shape.

    Args:
        orientation: "auto", "stored" or "exif".
    """

    def __init__(self, orientation: str):
        self.orientation = orientation
        self.turned: list[Path] = []
        self.ambiguous: list[Path] = []

    def choose(self, photo: Path, stated: tuple[float, float] | None) -> tuple[int, int, bool]:
        """Returns width and height of a photo in its camera's orientation, and whether that is EXIF's.

        Args:
            photo: the file.
            stated: width and height of its camera, of this size or another.

        Raises:
            InputError: see `image_header`.
        """
        width, height, _ = image_header(photo)
        header = read_header(photo)
        if header is None or header.orientation == 1:
            return width, height, False
        turned = image_header(photo, upright=True)[:2]
        fits = stated is None or has_shape((width, height), stated)
        use_exif = self.orientation == "exif" or (
            self.orientation == "auto" and not fits and stated is not None and has_shape(turned, stated)
        )
        if use_exif:
            self.turned.append(photo)
            return *turned, True
        if self.orientation == "auto" and (stated is None or has_shape(turned, stated)):
            self.ambiguous.append(photo)
        return width, height, False

    def report(self, where: object) -> None:
        """Says once how photos with an EXIF orientation were taken."""
        if self.turned:
            text = "%s: %d photos are turned as their EXIF orientation says, %s first: so they fit their cameras"
            log.warning(text, where, len(self.turned), self.turned[0].name)
        if self.ambiguous:
            text = (
                "%s: %d photos have an EXIF orientation, %s first; their cameras are taken to be about the pixels as stored"
                " (dataset.orientation=exif: about the turned photos)"
            )
            log.warning(text, where, len(self.ambiguous), self.ambiguous[0].name)


def has_shape(size: tuple[float, float], stated: tuple[float, float]) -> bool:
    """Whether a photo of one size may be that of another size, enlarged or reduced."""
    (width, height), (other_width, other_height) = size, stated
    off = max(abs(other_width * height / other_height - width), abs(other_height * width / other_width - height))
    return off <= MAX_ROUNDING_PX
