"""Mask files: matching to photos, reading, and what they mask out."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from nerf_lightning.dataset.formats.file_names import MASK_FOLDERS, normalize_name, walk_images
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.dataset.scene_bounds import extract_border
from nerf_lightning.errors import InputError
from nerf_lightning.utils.text import join_truncated

log = logging.getLogger(__name__)

MASK_THRESHOLD = 128
"""Brightness (or alpha) from which a mask keeps a pixel: white is kept, as in nerfstudio and COLMAP."""
MAX_NAMED = 4
"""Mask names in a message."""
CELLS_PER_SIDE = 16
"""Side of the coarse grid in which masks are averaged to detect inverted ones."""
MAX_COLOR_SPREAD = 12
"""Deviation from the median, in 1/255, within which JPEG pixels count as one color."""


def find_masks(photos: Sequence[Path], root: Path) -> list[Path | None]:
    """Finds the mask of each photo in a folder `masks`, `mask`, `images_mask` or `images_masks`.

    A mask has the photo's path below its folder, or only its name, possibly with a suffix or another extension. Photos
    without a mask are used whole, with a warning.

    Args:
        photos: image files.
        root: folder of the scene.

    Raises:
        InputError: several masks match a photo, or several photos a mask.
    """
    for folder in (parent / name for parent in _mask_parents(photos, root) for name in MASK_FOLDERS):
        if folder.is_dir():
            break
    else:
        return [None] * len(photos)
    masks = [(fold_mask(file.relative_to(folder)), file) for file in walk_images(folder)]
    common = Path(os.path.commonpath([photo.parent for photo in photos]))
    matches = [match_mask(folder, normalize_name(str(photo.relative_to(common))), photo, masks) for photo in photos]
    owners: dict[Path, Path] = {}
    for photo, mask in zip(photos, matches, strict=True):
        if mask is not None and (other := owners.setdefault(mask, photo)) != photo:
            text = f"one mask for {other.relative_to(common)} and {photo.relative_to(common)}"
            raise InputError(mask, "", text, hint="put masks into folders named as the photos'")
    missing = [photo.name for photo, mask in zip(photos, matches, strict=True) if mask is None]
    if len(missing) == len(photos):
        log.warning("%s: no mask matches a photo name, such as %s: masks ignored", folder, photos[0].stem + ".png")
    elif missing:
        log.warning("%s: no mask for %d of %d photos, such as %s", folder, len(missing), len(photos), missing[0])
    return matches


def _mask_parents(photos: Sequence[Path], root: Path) -> list[Path]:
    """Folders that may contain a mask folder: the photos', the one above, or the scene's."""
    common = Path(os.path.commonpath([photo.parent for photo in photos]))
    return list(dict.fromkeys([common.parent, common, photos[0].parent.parent, photos[0].parent, root]))


def fold_mask(path: Path) -> tuple[str, ...]:
    """Normalized parts of a mask path. COLMAP appends an extension to the photo's: `a.jpg.png` becomes `a`."""
    return normalize_name("/".join(normalize_name(path.as_posix())))


def match_mask(
    folder: Path, photo: tuple[str, ...], file: Path, masks: Sequence[tuple[tuple[str, ...], Path]]
) -> Path | None:
    """Finds the mask whose path and the photo's agree from the end, up to the shorter one.

    Args:
        folder: mask folder, for messages.
        photo: normalized path below the common folder of all photos.
        file: the photo.
        masks: normalized paths below their folder, and files.

    Raises:
        InputError: several masks match.
    """

    def fits(mask: tuple[str, ...], exact: bool) -> bool:
        name, base = mask[-1], photo[-1]
        extended = name.startswith(base) and len(name) > len(base) and not name[len(base)].isalnum()
        shared = min(len(mask), len(photo)) - 1
        return (name == base if exact else extended) and mask[-1 - shared : -1] == photo[-1 - shared : -1]

    matches = [path for mask, path in masks if fits(mask, True)] or [path for mask, path in masks if fits(mask, False)]
    if len(matches) > 1:
        shown = join_truncated([path.relative_to(folder).as_posix() for path in matches], MAX_NAMED)
        raise InputError(folder, "", f"{len(matches)} masks for {file.name}: {shown}", hint="keep one")
    return matches[0] if matches else None


def read_mask(path: Path, width: int, height: int, invert: bool) -> UInt8[np.ndarray, "H W"]:
    """Reads a mask at the size of its photo: 255 keeps a pixel, 0 masks it, values between are area averages.

    Raises:
        InputError: not an image.
    """
    pixels = read_pixels(path)
    gray = pixels[..., 3] if pixels.shape[2] == 4 else pixels.max(axis=2)
    mask = np.where(gray >= MASK_THRESHOLD, 255, 0).astype(np.uint8)
    mask = 255 - mask if invert else mask
    interpolation = cv2.INTER_AREA if mask.shape[1] >= width and mask.shape[0] >= height else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(mask, (width, height), interpolation=interpolation), np.uint8)


def is_cut_out_by_mask(image: UInt8[np.ndarray, "H W C"], mask: Bool[np.ndarray, "H W"]) -> bool:
    """True if the masked region covers most of the border in one color, that is, the subject was cut out."""
    if extract_border(mask).mean() > 0.5:
        return False
    masked = image[..., :3][~mask]
    middle = np.median(masked, axis=0)
    return bool(np.mean(np.abs(masked - middle).max(axis=1) <= MAX_COLOR_SPREAD) > 0.95)


def is_inverted(masks: Sequence[Bool[np.ndarray, "_ _"]]) -> bool:
    """True if most masks remove a region in the middle and keep the borders: probably the subject."""
    grid = CELLS_PER_SIDE, CELLS_PER_SIDE
    small = [cv2.resize(mask.astype(np.float32), grid, interpolation=cv2.INTER_AREA) for mask in masks]
    mask = np.mean(small, axis=0)
    quarter = CELLS_PER_SIDE // 4
    return bool(mask[quarter:-quarter, quarter:-quarter].min() < 0.3 and extract_border(mask).mean() > 0.7)
