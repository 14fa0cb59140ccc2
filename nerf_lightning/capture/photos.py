"""A folder of photos: which files, in which order, of which size."""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from nerf_lightning.errors import InputError

T = TypeVar("T")

EXTENSIONS = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}
UNREAD = {".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".webp", ".avif", ".mov", ".mp4"}
"""Files of cameras and phones that nothing here reads."""


def natural(path: Path) -> list[tuple[int, int, str]]:
    """Sorts photo 9 before photo 10."""
    parts = re.findall(r"(\d+)|(\D+)", path.name.lower())
    return [(0, int(number), "") if number else (1, 0, text) for number, text in parts]


def find_photos(folder: Path, key: str) -> list[Path]:
    """The photos in a folder in natural order, without those in folders below it.

    Args:
        folder: where they are.
        key: the config key that named it, for the message.

    Raises:
        InputError: no such folder, or no photo in it.
    """
    if not folder.is_dir():
        raise InputError("config", key, f"{folder}, which is no folder", "a folder of photos")
    files = [file for file in folder.iterdir() if file.is_file() and not file.name.startswith(".")]
    photos = sorted((file for file in files if file.suffix.lower() in EXTENSIONS), key=natural)
    if not photos:
        others = sorted({file.suffix.lower() for file in files} & UNREAD)
        found = f"only {', '.join(others)} files" if others else "no photo"
        raise InputError(folder, "", found, "JPEG, PNG or TIFF photos", "convert them first" if others else "")
    return photos


def spread(items: Sequence[T], most: int) -> list[T]:
    """At most this many, evenly chosen, the first and the last among them."""
    if len(items) <= most:
        return list(items)
    return [items[i] for i in np.linspace(0, len(items) - 1, most).round().astype(int)]


def of_one_size(
    folder: Path, sizes: Mapping[str, tuple[int, int]], size: tuple[int, int] | None = None
) -> dict[str, str]:
    """Photos that do not have the commonest size (or `size`), and what is wrong with each.

    Args:
        folder: where they are, for the message.
        sizes: width and height by name.
        size: of the photos that were calibrated.

    Raises:
        InputError: no photo is of that size.
    """
    width, height = size or Counter(sizes.values()).most_common(1)[0][0]
    wrong = {}
    for name, (w, h) in sizes.items():
        if (w, h) != (width, height):
            turned = (h, w) == (width, height)
            advice = "held the other way" if turned else "of another size"
            wrong[name] = (
                f"{w}x{h} pixels, {advice}: {width}x{height} is what {'was calibrated' if size else 'most have'}"
            )
    if len(wrong) == len(sizes):
        name, reason = next(iter(wrong.items()))
        raise InputError(
            folder / name,
            "",
            reason,
            "photos of the size and orientation of the calibration",
            "take both with one camera, held one way, without zooming",
        )
    return wrong
