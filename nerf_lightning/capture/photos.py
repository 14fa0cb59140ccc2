"""Photos of another size than most."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.capture.tags.detect import Sighting
from nerf_lightning.errors import InputError


def find_wrong_sizes(folder: Path, photos: Sequence[Sighting], size: tuple[int, int] | None = None) -> dict[str, str]:
    """Photos that do not have the commonest size (or `size`, that of the calibration), and what is wrong with each.

    Raises:
        InputError: no photo is of that size.
    """
    width, height = size or Counter((p.width, p.height) for p in photos).most_common(1)[0][0]
    expected = f"{width}x{height} is what {'was calibrated' if size else 'most have'}"
    wrong = {}
    for photo in photos:
        if (photo.width, photo.height) != (width, height):
            turned = "held the other way" if (photo.height, photo.width) == (width, height) else "of another size"
            wrong[photo.name] = f"{photo.width}x{photo.height} pixels, {turned}: {expected}"
    if len(wrong) == len(photos):
        name, reason = next(iter(wrong.items()))
        advice = "take both with one camera, held one way, without zooming"
        raise InputError(folder / name, "", reason, "photos of the size and orientation of the calibration", advice)
    return wrong
