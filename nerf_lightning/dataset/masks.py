"""Masks beside photos: which file belongs to which photo, and which pixels it keeps."""

import logging
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.dataset.formats.names import MASK_FOLDERS, fold_name, walk_images
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

MIN_KEPT = 128
"""Brightness, or alpha, from which a mask keeps a pixel: white is kept, as nerfstudio and COLMAP have it."""


def find_masks(photos: Sequence[Path], root: Path) -> list[Path | None]:
    """Finds the mask of each photo in a folder `masks`, `mask`, `images_mask` or `images_masks` beside the photos' own.

    A mask has the photo's path, from its end on, perhaps with another extension or one appended. Where some photos have a mask
    and others none, those count whole; a line says so.

    Args:
        photos: their files.
        root: the scene's folder.

    Raises:
        InputError: several masks of one photo, or one of several photos.
    """
    common = Path(os.path.commonpath([photo.parent for photo in photos]))
    parents = (common.parent, common, photos[0].parent.parent, photos[0].parent, root)
    folders = [parent / name for parent in parents for name in MASK_FOLDERS if (parent / name).is_dir()]
    if not folders:
        return [None] * len(photos)
    folder = folders[0]
    masks: dict[tuple[str, ...], Path] = {}
    for file in walk_images(folder):
        # COLMAP appends an extension to the photo's: `a.jpg.png` belongs to `a.jpg`.
        path = fold_name("/".join(fold_name(file.relative_to(folder).as_posix())))
        if (other := masks.setdefault(path, file)) != file:
            raise InputError(folder, "", f"{other.name} and {file.name}, masks of one photo", "one mask for each photo")
    owners: dict[Path, Path] = {}
    found = []
    for photo in photos:
        path = fold_name(photo.as_posix())
        mask = next((masks[path[i:]] for i in range(len(path)) if path[i:] in masks), None)
        if mask is not None and (other := owners.setdefault(mask, photo)) != photo:
            text = f"one mask for {other.relative_to(common)} and {photo.relative_to(common)}"
            raise InputError(mask, "", text, "a mask for each photo", "put masks into folders named as the photos'")
        found.append(mask)
    missing = [photo.name for photo, mask in zip(photos, found, strict=True) if mask is None]
    if missing:
        log.warning("%s: no mask for %d of %d photos, %s first", folder, len(missing), len(photos), missing[0])
    return found


def read_mask(path: Path, width: int, height: int, invert: bool) -> UInt8[np.ndarray, "H W"]:
    """A mask in the size of its photo: 255 where the photo is kept, 0 where it is masked, and between where a pixel of the
    photo is of several of the mask.

    Raises:
        InputError: no picture.
    """
    pixels = read_pixels(path)
    grey = pixels[..., 3] if pixels.shape[2] == 4 else pixels.max(axis=2)
    mask = np.where((grey >= MIN_KEPT) != invert, 255, 0).astype(np.uint8)
    way = cv2.INTER_AREA if mask.shape[1] >= width and mask.shape[0] >= height else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(mask, (width, height), interpolation=way), np.uint8)
