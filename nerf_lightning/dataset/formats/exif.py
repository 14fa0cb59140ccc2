"""What cameras write into their photos."""

import math
from pathlib import Path

from nerf_lightning.dataset.formats.header import DAMAGED, read_header

EXPOSURE, APERTURE, SPEED = 0x829A, 0x829D, 0x8827
"""Numbers of EXIF tags: seconds, f-number and ISO speed."""


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
