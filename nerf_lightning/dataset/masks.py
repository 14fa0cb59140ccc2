"""Masks beside photos: which file belongs to which photo, and what is masked."""

import logging
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from nerf_lightning.dataset.extent import around
from nerf_lightning.dataset.formats.decode import EXTENSIONS, read_pixels

log = logging.getLogger(__name__)

FOLDERS = ("masks", "mask", "images_mask", "images_masks")
KEPT = 128
"""Brightness, or alpha, from which a mask keeps a pixel: white is kept, as nerfstudio and COLMAP have it."""
SURE = 250
"""Share of a pixel, in 1/255, that must be known after averaging for the pixel to be known."""
CELLS = 16
"""Along each side of a photo, to see where most masks leave something out."""
FLAT = 12
"""In 1/255: JPEG lets one colour wobble by that much."""


def find_masks(photos: Sequence[Path], root: Path) -> list[Path | None]:
    """The mask of each photo: in a folder `masks`, `mask`, `images_mask` or `images_masks` beside the photos' own.

    A mask has the photo's name, perhaps with more at its end or another extension. Where some photos have a mask and others
    none, those count whole; a line says so.

    Args:
        photos: their files.
        root: the scene's folder.
    """
    for folder in (parent / name for parent in _beside(photos, root) for name in FOLDERS):
        if folder.is_dir():
            break
    else:
        return [None] * len(photos)
    files = sorted(file for file in folder.rglob("*") if file.suffix.lower() in {e.lower() for e in EXTENSIONS})
    found = [_mask_of(photo, files) for photo in photos]
    without = [photo.name for photo, mask in zip(photos, found, strict=True) if mask is None]
    if len(without) == len(photos):
        log.warning("%s: no mask has the name of a photo, such as %s: masks left out", folder, photos[0].stem + ".png")
    elif without:
        log.warning("%s: no mask for %d of %d photos, %s first", folder, len(without), len(photos), without[0])
    return found


def _beside(photos: Sequence[Path], root: Path) -> list[Path]:
    """Where a folder of masks may stand: beside the folder of the photos, in it, or in the scene's folder."""
    own = photos[0].parent
    return list(dict.fromkeys([own.parent, own, root]))


def _mask_of(photo: Path, files: Sequence[Path]) -> Path | None:
    """The one file that is named after a photo."""
    exact = [file for file in files if file.stem in (photo.stem, photo.name)]
    if exact:
        return exact[0]
    longer = [f for f in files if f.stem.startswith(photo.stem) and not f.stem[len(photo.stem)].isalnum()]
    return longer[0] if len(longer) == 1 else None


def read_mask(path: Path, width: int, height: int, invert: bool) -> UInt8[np.ndarray, "H W"]:
    """A mask in the size of its photo: 255 where the photo is kept, 0 where it is masked.

    Raises:
        InputError: no picture.
    """
    pixels = read_pixels(path)
    grey = pixels[..., 3] if pixels.shape[2] == 4 else pixels.max(axis=2)
    mask = np.where(grey >= KEPT, 255, 0).astype(np.uint8)
    mask = 255 - mask if invert else mask
    return np.asarray(cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)


def cut_out(image: UInt8[np.ndarray, "H W C"], kept: Bool[np.ndarray, "H W"]) -> bool:
    """Whether what a mask leaves out is most of the photo's border, and of one colour: its subject is cut out already."""
    if around(kept).mean() > 0.5:
        return False
    masked = image[..., :3][~kept]
    middle = np.median(masked, axis=0)
    return bool(np.mean(np.abs(masked - middle).max(axis=1) <= FLAT) > 0.95)


def seem_inverted(masks: Sequence[Bool[np.ndarray, "_ _"]]) -> bool:
    """Whether masks leave out one spot in the middle of most photos and keep the borders: what is photographed, it seems."""
    small = [cv2.resize(kept.astype(np.float32), (CELLS, CELLS), interpolation=cv2.INTER_AREA) for kept in masks]
    kept = np.mean(small, axis=0)
    quarter = CELLS // 4
    return bool(kept[quarter:-quarter, quarter:-quarter].min() < 0.3 and around(kept).mean() > 0.7)
