"""Masks beside photos: which file belongs to which photo, and what is masked."""

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
"""Brightness, or alpha, from which a mask keeps a pixel: white is kept, as nerfstudio and COLMAP have it."""
MAX_NAMED = 4
"""Masks that a message names."""
CELLS_PER_SIDE = 16
"""Of a coarse grid over a photo, to see where most masks leave something out."""
MAX_COLOR_SPREAD = 12
"""Of one colour, in 1/255, after JPEG."""


def find_masks(photos: Sequence[Path], root: Path) -> list[Path | None]:
    """Finds the mask of each photo in a folder `masks`, `mask`, `images_mask` or `images_masks` beside the photos' own.

    A mask has the photo's path below its folder, or its name alone, perhaps with more at its end or another extension. Where
    some photos have a mask and others none, those count whole; a line says so.

    Args:
        photos: their files.
        root: the scene's folder.

    Raises:
        InputError: several masks may be meant, or one of several photos.
    """
    for folder in (parent / name for parent in _mask_parents(photos, root) for name in MASK_FOLDERS):
        if folder.is_dir():
            break
    else:
        return [None] * len(photos)
    masks = [(fold_mask(file.relative_to(folder)), file) for file in walk_images(folder)]
    common = Path(os.path.commonpath([photo.parent for photo in photos]))
    found = [match_mask(folder, normalize_name(str(photo.relative_to(common))), photo, masks) for photo in photos]
    owners: dict[Path, Path] = {}
    for photo, mask in zip(photos, found, strict=True):
        if mask is not None and (other := owners.setdefault(mask, photo)) != photo:
            text = f"one mask for {other.relative_to(common)} and {photo.relative_to(common)}"
            raise InputError(mask, "", text, hint="put masks into folders named as the photos'")
    missing = [photo.name for photo, mask in zip(photos, found, strict=True) if mask is None]
    if len(missing) == len(photos):
        log.warning("%s: no mask has the name of a photo, such as %s: masks left out", folder, photos[0].stem + ".png")
    elif missing:
        log.warning("%s: no mask for %d of %d photos, %s first", folder, len(missing), len(photos), missing[0])
    return found


def _mask_parents(photos: Sequence[Path], root: Path) -> list[Path]:
    """Folders that may contain one of masks: above or in that of the photos, or the scene's."""
    common = Path(os.path.commonpath([photo.parent for photo in photos]))
    return list(dict.fromkeys([common.parent, common, photos[0].parent.parent, photos[0].parent, root]))


def fold_mask(path: Path) -> tuple[str, ...]:
    """The folded parts of a mask's path; COLMAP appends an extension to the photo's: `a.jpg.png` becomes `a`."""
    return normalize_name("/".join(normalize_name(path.as_posix())))


def match_mask(
    folder: Path, photo: tuple[str, ...], file: Path, masks: Sequence[tuple[tuple[str, ...], Path]]
) -> Path | None:
    """Finds the one mask whose path, from its end on, is the photo's as far as both go.

    Args:
        folder: of the masks, for messages.
        photo: folded path below the folder that all photos share.
        file: the photo.
        masks: folded paths below their folder, and files.

    Raises:
        InputError: several fit.
    """

    def fits(mask: tuple[str, ...], exact: bool) -> bool:
        name, base = mask[-1], photo[-1]
        longer = name.startswith(base) and len(name) > len(base) and not name[len(base)].isalnum()
        shared = min(len(mask), len(photo)) - 1
        return (name == base if exact else longer) and mask[-1 - shared : -1] == photo[-1 - shared : -1]

    found = [path for mask, path in masks if fits(mask, True)] or [path for mask, path in masks if fits(mask, False)]
    if len(found) > 1:
        shown = join_truncated([path.relative_to(folder).as_posix() for path in found], MAX_NAMED)
        raise InputError(folder, "", f"{len(found)} masks for {file.name}: {shown}", hint="keep one")
    return found[0] if found else None


def read_mask(path: Path, width: int, height: int, invert: bool) -> UInt8[np.ndarray, "H W"]:
    """A mask in the size of its photo: 255 where the photo is kept, 0 where it is masked, and between where a pixel of the
    photo is of several of the mask.

    Raises:
        InputError: no picture.
    """
    pixels = read_pixels(path)
    grey = pixels[..., 3] if pixels.shape[2] == 4 else pixels.max(axis=2)
    mask = np.where(grey >= MASK_THRESHOLD, 255, 0).astype(np.uint8)
    mask = 255 - mask if invert else mask
    way = cv2.INTER_AREA if mask.shape[1] >= width and mask.shape[0] >= height else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(mask, (width, height), interpolation=way), np.uint8)


def is_cut_out_by_mask(image: UInt8[np.ndarray, "H W C"], kept: Bool[np.ndarray, "H W"]) -> bool:
    """Whether what a mask leaves out is most of the photo's border, and of one colour: its subject is cut out already."""
    if extract_border(kept).mean() > 0.5:
        return False
    masked = image[..., :3][~kept]
    middle = np.median(masked, axis=0)
    return bool(np.mean(np.abs(masked - middle).max(axis=1) <= MAX_COLOR_SPREAD) > 0.95)


def is_inverted(masks: Sequence[Bool[np.ndarray, "_ _"]]) -> bool:
    """Whether masks leave out one spot in the middle of most photos and keep the borders: what is photographed, it seems."""
    grid = CELLS_PER_SIDE, CELLS_PER_SIDE
    small = [cv2.resize(kept.astype(np.float32), grid, interpolation=cv2.INTER_AREA) for kept in masks]
    kept = np.mean(small, axis=0)
    quarter = CELLS_PER_SIDE // 4
    return bool(kept[quarter:-quarter, quarter:-quarter].min() < 0.3 and extract_border(kept).mean() > 0.7)
