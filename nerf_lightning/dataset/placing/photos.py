"""A folder of photos: which files, in which order."""

import re
from pathlib import Path

from nerf_lightning.dataset.formats.names import list_images
from nerf_lightning.errors import InputError


def natural(path: Path) -> list[tuple[int, int, str]]:
    """Sorts photo 9 before photo 10."""
    parts = re.findall(r"(\d+)|(\D+)", path.name.lower())
    return [(0, int(number), "") if number else (1, 0, text) for number, text in parts]


def has_photos(folder: Path) -> bool:
    """Whether a folder holds photos itself."""
    return folder.is_dir() and bool(list_images(folder))


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
    photos = sorted(list_images(folder), key=natural)
    if not photos:
        others = sorted({file.suffix.lower() for file in folder.iterdir() if file.suffix})
        found = f"only {', '.join(others)} files" if others else "no photo"
        raise InputError(
            folder, "", found, "JPEG, PNG, TIFF, WebP or HEIC photos", "convert them first" if others else ""
        )
    return photos
