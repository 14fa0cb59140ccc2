"""Image files: size, alpha and EXIF tags, and pixels of any depth and channel count as 8-bit RGB or RGBA."""

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
"""Files whose headers are kept in memory."""
DRAFT_SCALES = (8, 4, 2)
"""Factors by which libjpeg reduces while it decodes."""
MIN_OVERSAMPLING = 2
"""Least ratio of a reduced JPEG's sides to those it is averaged to, where they differ: its low-pass filter is sharper than
an average, and shows only where little is averaged afterwards (43 dB against the average of the whole photo, else above 50)."""
JPEG_MAGIC = b"\xff\xd8"
HEIC_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""Brands after `ftyp` in photos of phones (ISO 23008-12); the last two stand for any codec."""
ORIENTATION_TAG, EXIF_IFD_TAG, EXPOSURE_TAG, APERTURE_TAG, ISO_TAG = 0x0112, 0x8769, 0x829A, 0x829D, 0x8827
"""Numbers of EXIF tags: how the camera was held, those about how a photo was taken, seconds, f-number and ISO speed."""
ORIENTATION_TRANSPOSES = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What brings a photo of an EXIF orientation upright."""
SIDEWAYS_ORIENTATIONS = (5, 6, 7, 8)
"""Orientations of photos that lie on their side."""
DECODE_ERRORS = (OSError, ValueError, SyntaxError, KeyError, TypeError, OverflowError, ZeroDivisionError, struct.error)
"""What Pillow raises for broken tags or pixels, or for a picture of a kind that it does not know."""
FORMATS = "a whole PNG, JPEG, TIFF, WebP or HEIC image of 8 or 16 bits a channel"


@dataclass(frozen=True)
class ImageHeader:
    """What one image file says before its pixels."""

    width: int
    """As stored, in pixels."""
    height: int
    alpha: bool
    orientation: int
    """As EXIF says; 1 for upright as stored, and with alpha."""
    tags: Mapping[int, Any]
    """EXIF tags by their numbers, but for those of raw bytes, as makers' notes; none where there are none, or broken ones."""


@contextmanager
def open_image(path: Path) -> Iterator[Image.Image]:
    """An image file, not decoded yet.

    Raises:
        InputError: it is none that Pillow reads, is damaged, or is HEIC without the package that reads it; in the block too.
    """
    with require_file(path).open("rb") as file:
        start = file.read(12)
    if start[8:] in HEIC_BRANDS:
        require_extra(
            "heic", "pillow_heif", purpose="the optional extra that reads HEIC photos", hint=", or convert them"
        )
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
    """The header of an image file.

    Raises:
        InputError: see `open_image`.
    """
    stat = require_file(path).stat()
    return _read_header(path, stat.st_size, stat.st_mtime_ns)


@lru_cache(maxsize=MAX_HEADERS)
def _read_header(path: Path, size: int, mtime_ns: int) -> ImageHeader:
    """The other arguments tell versions of a file apart."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of sizes: nothing is decoded here; and on tags that nothing asks for
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
    """Width, height, and whether there is alpha.

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
    """Light that a photo gathered, by its tags: seconds times ISO speed over the squared f-number; None if they do not say."""
    tags = read_header(path).tags
    try:
        speed = tags[ISO_TAG]
        first = speed[0] if isinstance(speed, tuple) else speed  # of two kinds of sensitivity
        found = float(tags[EXPOSURE_TAG]) * float(first) / float(tags[APERTURE_TAG]) ** 2
    except (*DECODE_ERRORS, IndexError):
        return None
    return found if 0 < found < math.inf else None


def read_pixels(path: Path, upright: bool = False, size: tuple[int, int] | None = None) -> UInt8[np.ndarray, "H W C"]:
    """Decodes one image: RGB, or RGBA with straight alpha; 16 bits become 8, grey becomes RGB.

    Args:
        path: PNG, JPEG, TIFF or whatever else Pillow reads, or HEIC.
        upright: apply the EXIF rotation (not to images with alpha). Off for posed photos, whose poses and intrinsics
            are about the pixels as stored. HEIC photos are upright always: the rotation is part of their format.
        size: width and height that the caller averages it to. A JPEG is then decoded at 1/2, 1/4 or 1/8 of its size where
            that is exact and leaves enough pixels.

    Raises:
        InputError: missing, truncated, not an image, or of floating-point pixels; HEIC without the package that reads it.
    """
    header = read_header(path)
    orientation = header.orientation if upright else 1
    wanted = size[::-1] if size is not None and orientation in SIDEWAYS_ORIENTATIONS else size
    with open_image(path) as image:
        image.verify()  # checksums of a PNG, which decoding does not look at
    with open_image(path) as image:
        factor = 1
        if wanted is not None and isinstance(image, JpegImageFile):
            factor = choose_draft_scale(header.width, header.height, wanted)
        check_memory(path, "", f"{header.width}x{header.height} pixels", 4 * header.width * header.height // factor**2)
        image.draft(image.mode, (header.width // factor, header.height // factor))
        if image.mode in ("I", "F"):
            raise InputError(path, "", "pixels of 32 bits", FORMATS, "convert it")
        if image.mode.startswith("I;16"):
            image = Image.fromarray(((np.asarray(image, np.uint32) + 128) // 257).astype(np.uint8))
        if image.mode != (mode := "RGBA" if header.alpha else "RGB"):
            image = image.convert(mode)
        return np.array(image if orientation == 1 else image.transpose(ORIENTATION_TRANSPOSES[orientation]))


def choose_draft_scale(width: int, height: int, wanted: tuple[int, int]) -> int:
    """The largest factor by which libjpeg may reduce a photo that is averaged to `wanted` pixels afterwards."""
    for factor in DRAFT_SCALES:
        reduced = width // factor, height // factor
        exact = (width % factor, height % factor) == (0, 0)
        if exact and (
            reduced == wanted or all(a >= MIN_OVERSAMPLING * b for a, b in zip(reduced, wanted, strict=True))
        ):
            return factor
    return 1
