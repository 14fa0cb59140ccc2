"""Reads image files: headers with size, alpha and EXIF tags, and pixels as 8-bit RGB or RGBA."""

import math
import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image
from PIL.JpegImagePlugin import JpegImageFile

from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require_extra
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import require_file

MAX_DECODE_THREADS = 4
MAX_HEADERS = 4096
"""Headers cached in memory."""
DRAFT_SCALES = (8, 4, 2)
"""Downscaling factors of libjpeg's decoder."""
OVERSAMPLING = 2
"""Minimum oversampling of a JPEG draft that is averaged further: libjpeg's filter is sharper than area averaging, which is
visible only if little is averaged afterwards (43 dB against averaging the full photo, otherwise above 50)."""
JPEG_MAGIC = b"\xff\xd8"
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""Brands after `ftyp` in phone photos (ISO 23008-12); the last two allow any codec."""
ORIENTATION_TAG, EXIF_IFD_TAG, EXPOSURE_TAG, APERTURE_TAG, ISO_TAG = 0x0112, 0x8769, 0x829A, 0x829D, 0x8827
"""EXIF tag ids: orientation, Exif IFD, exposure time in seconds, f-number and ISO speed."""
ORIENTATION_TRANSPOSES = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""Transpose that makes a photo of each EXIF orientation upright."""
SIDEWAYS_ORIENTATIONS = (5, 6, 7, 8)
"""Orientations rotated by 90 degrees."""
DECODE_ERRORS = (OSError, ValueError, SyntaxError, KeyError, TypeError, OverflowError, ZeroDivisionError, struct.error)
"""Errors that Pillow raises for broken tags or pixels, or unsupported kinds of image."""
FORMATS = "a whole PNG, JPEG, TIFF, WebP or HEIC image of 8 or 16 bits a channel"


@dataclass(frozen=True)
class ImageHeader:
    """Header of one image file."""

    width: int
    """As stored, in pixels."""
    height: int
    alpha: bool
    orientation: int
    """EXIF orientation; 1 (upright) with alpha."""
    tags: Mapping[int, Any]
    """EXIF tags by id, without raw bytes (maker notes); empty if missing or broken."""


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """Opens an image file without decoding it.

    Raises:
        InputError: unsupported, damaged, or HEIC without pillow_heif; also for errors inside the block.
    """
    with require_file(path).open("rb") as file:
        start = file.read(12)
    if start[8:] in HEIC_BRANDS:
        require_extra("heic", "pillow_heif", purpose="the optional extra for HEIC photos", hint=", or convert them")
        import pillow_heif

        pillow_heif.register_heif_opener()
    try:
        # Image.open refuses photos of 200 megapixels as bombs.
        with JpegImageFile(path) if start.startswith(JPEG_MAGIC) else Image.open(path) as image:
            yield image
    except InputError:
        raise
    except (*DECODE_ERRORS, Image.DecompressionBombError) as error:
        raise InputError(path, "", f"no readable image ({error})", hint="copy it again or convert it") from error


def read_header(path: Path) -> ImageHeader:
    """Reads the header of an image file (cached).

    Raises:
        InputError: see `open_image`.
    """
    stat = require_file(path).stat()
    return _read_header(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=MAX_HEADERS)
def _read_header(path: Path, size: int, mtime_ns: int) -> ImageHeader:
    """Size and time are part of the cache key, so that changed files are read again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about large sizes (nothing is decoded here) and unused tags
        with open_image(path) as image:
            alpha, tags = image.has_transparency_data, _read_tags(image)
            orientation = 1 if alpha else tags.get(ORIENTATION_TAG, 1)
            return ImageHeader(*image.size, alpha, orientation if orientation in ORIENTATION_TRANSPOSES else 1, tags)


def _read_tags(image: Image.Image) -> dict[int, Any]:
    try:
        exif = image.getexif()
        tags = {**exif, **exif.get_ifd(EXIF_IFD_TAG)}
        return {tag: value for tag, value in tags.items() if not isinstance(value, bytes)}
    except DECODE_ERRORS:
        return {}


def read_image_size(path: Path, upright: bool = False) -> tuple[int, int, bool]:
    """Reads width, height, and whether there is alpha.

    Args:
        path, upright: see `read_pixels`.

    Raises:
        InputError: see `open_image`.
    """
    header = read_header(path)
    if upright and header.orientation in SIDEWAYS_ORIENTATIONS:
        return header.height, header.width, header.alpha
    return header.width, header.height, header.alpha


def read_exposure(path: Path) -> float | None:
    """Computes the exposure from EXIF: seconds x ISO speed / f-number^2; None if tags are missing."""
    tags = read_header(path).tags
    try:
        speed = tags[ISO_TAG]
        iso = speed[0] if isinstance(speed, tuple) else speed  # the tag may have two kinds of sensitivity
        exposure = float(tags[EXPOSURE_TAG]) * float(iso) / float(tags[APERTURE_TAG]) ** 2
    except (*DECODE_ERRORS, IndexError):
        return None
    return exposure if 0 < exposure < math.inf else None


def read_pixels(path: Path, upright: bool = False, size: tuple[int, int] | None = None) -> UInt8[np.ndarray, "H W C"]:
    """Decodes one image: RGB, or RGBA with straight alpha; 16 bits become 8, gray becomes RGB.

    Args:
        path: PNG, JPEG, TIFF, another format of Pillow, or HEIC.
        upright: apply the EXIF rotation (not to images with alpha). Off for posed photos, whose poses and intrinsics
            refer to the stored pixels. HEIC photos are always upright: the rotation is part of the format.
        size: width and height to which the caller averages. JPEGs are then decoded at 1/2, 1/4 or 1/8 of their size if
            that is exact and leaves enough pixels.

    Raises:
        InputError: missing, truncated, not an image, floating-point pixels, or HEIC without pillow_heif.
    """
    header = read_header(path)
    orientation = header.orientation if upright else 1
    target = size[::-1] if size is not None and orientation in SIDEWAYS_ORIENTATIONS else size
    with open_image(path) as image:
        image.verify()  # PNG checksums, which decoding ignores
    with open_image(path) as image:
        factor = 1
        if target is not None and isinstance(image, JpegImageFile):
            factor = choose_draft_scale(header.width, header.height, target)
        check_memory(path, "", f"{header.width}x{header.height} pixels", 4 * header.width * header.height // factor**2)
        image.draft(image.mode, (header.width // factor, header.height // factor))
        if image.mode in ("I", "F"):
            raise InputError(path, "", "32-bit pixels", FORMATS, "convert it")
        if image.mode.startswith("I;16"):
            image = Image.fromarray(((np.asarray(image, np.uint32) + 128) // 257).astype(np.uint8))
        if image.mode != (mode := "RGBA" if header.alpha else "RGB"):
            image = image.convert(mode)
        return np.array(image if orientation == 1 else image.transpose(ORIENTATION_TRANSPOSES[orientation]))


def choose_draft_scale(width: int, height: int, target: tuple[int, int]) -> int:
    """Chooses the largest libjpeg downscaling factor for a photo that is averaged to `target` pixels afterwards."""
    for factor in DRAFT_SCALES:
        reduced = width // factor, height // factor
        exact = (width % factor, height % factor) == (0, 0)
        if exact and (reduced == target or all(a >= OVERSAMPLING * b for a, b in zip(reduced, target, strict=True))):
            return factor
    return 1
