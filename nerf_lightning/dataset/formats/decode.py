"""Image files to arrays: any depth and channel count becomes 8-bit RGB or RGBA.

Pillow decodes JPEG, as it reports files that are cut short and decodes at reduced scale. OpenCV decodes the rest: Pillow
cuts 16-bit colour to its high byte and cannot open TIFFs of floats to say so.
"""

import zlib
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8
from PIL.JpegImagePlugin import JpegImageFile

from nerf_lightning.dataset.formats.header import DAMAGED, JPEG, QUARTER_TURNS, read_header
from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import existing_file

cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # `read_pixels` says what is wrong with a file

THREADS = 4
DRAFT_SCALES = (8, 4, 2)
"""Factors by which libjpeg reduces while it decodes."""
OVERSAMPLING = 2
"""Least ratio of a reduced JPEG's sides to those it is averaged to, where they differ: its low-pass filter is sharper than
an average, and shows only where little is averaged afterwards (43 dB against the average of the whole photo, else above 50)."""
CONVERSIONS = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGBA}
"""From OpenCV's channels, by their count."""
PNG = b"\x89PNG"
HEIC = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")
"""Brands after `ftyp` in photos of phones (ISO 23008-12); the last two stand for any codec."""


def read_pixels(path: Path, upright: bool = False, size: tuple[int, int] | None = None) -> UInt8[np.ndarray, "H W C"]:
    """Decodes one image: RGB, or RGBA with straight alpha; 16 bits become 8, grey becomes RGB.

    Args:
        path: PNG, JPEG, TIFF or whatever else OpenCV reads, or HEIC.
        upright: apply the EXIF rotation (not to images with alpha). Off for posed photos, whose poses and intrinsics
            are about the pixels as stored. HEIC photos are upright always: the rotation is part of their format.
        size: width and height that the caller averages it to. A JPEG is then decoded at 1/2, 1/4 or 1/8 of its size where
            that is exact and leaves enough pixels.

    Raises:
        InputError: missing, truncated, not an image, or of floating-point pixels; HEIC without the package that reads it.
    """
    existing_file(path)
    header = read_header(path)
    orientation = header.orientation if upright and header is not None and not header.alpha else 1
    try:
        data = path.read_bytes()
        if data.startswith(JPEG):
            wanted = size[::-1] if size is not None and orientation in QUARTER_TURNS else size
            return turn_upright(_decode_jpeg(path, data, wanted), orientation)
        if data.startswith(PNG):
            _check_png(path, data)
        # UNCHANGED keeps alpha and 16 bits, and leaves the EXIF rotation alone.
        raw = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except (cv2.error, OSError) as error:
        raise InputError(path, "", f"an unreadable image ({error})", "a PNG, JPEG or TIFF") from error
    if raw is None and data[8:12] in HEIC:
        return _heic(path, data)
    if raw is None:
        raise InputError(path, "", f"{len(data)} bytes that are no image", "a PNG, JPEG or TIFF", "copy it again")
    return turn_upright(_rgb8(path, raw), orientation)


def turn_upright(image: UInt8[np.ndarray, "H W C"], orientation: int) -> UInt8[np.ndarray, "h w C"]:
    """A photo as its EXIF orientation says."""
    image = image.transpose(1, 0, 2) if orientation in QUARTER_TURNS else image
    image = image[:, ::-1] if orientation in (2, 3, 6, 7) else image
    image = image[::-1] if orientation in (3, 4, 7, 8) else image
    return np.ascontiguousarray(image)


def image_header(path: Path, upright: bool = False) -> tuple[int, int, bool]:
    """Width, height, and whether there is alpha, from the file's header alone where Pillow knows it.

    Args:
        path, upright: see `read_pixels`.

    Raises:
        InputError: see `read_pixels`.
    """
    existing_file(path)
    header = read_header(path)
    if header is None:
        shape = read_pixels(path, upright).shape  # says what is wrong
        return shape[1], shape[0], shape[2] == 4
    if upright and not header.alpha and header.orientation in QUARTER_TURNS:
        return header.height, header.width, header.alpha
    return header.width, header.height, header.alpha


def _decode_jpeg(path: Path, data: bytes, wanted: tuple[int, int] | None) -> UInt8[np.ndarray, "H W 3"]:
    try:
        with JpegImageFile(BytesIO(data)) as image:
            width, height = image.size
            factor = 1 if wanted is None else draft_scale(width, height, wanted)
            check_memory(path, "", f"{width}x{height} pixels", 3 * width * height // factor**2)
            image.draft(image.mode, (width // factor, height // factor))
            image.load()
            return np.array(image if image.mode == "RGB" else image.convert("RGB"))
    except DAMAGED as error:
        found = f"an image that was cut short or changed ({error})"
        raise InputError(path, "", found, "a whole JPEG", "copy it again") from error


def draft_scale(width: int, height: int, wanted: tuple[int, int]) -> int:
    """The largest factor by which libjpeg may reduce a photo that is averaged to `wanted` pixels afterwards."""
    for factor in DRAFT_SCALES:
        reduced = width // factor, height // factor
        exact = (width % factor, height % factor) == (0, 0)
        if exact and (reduced == wanted or all(a >= OVERSAMPLING * b for a, b in zip(reduced, wanted, strict=True))):
            return factor
    return 1


def _rgb8(path: Path, raw: Shaped[np.ndarray, "..."]) -> UInt8[np.ndarray, "H W C"]:
    if raw.dtype == np.uint16:
        raw = ((raw.astype(np.uint32) + 128) // 257).astype(np.uint8)
    if raw.dtype != np.uint8:
        raise InputError(path, "", f"{raw.dtype} pixels", "8 or 16 bits a channel")
    raw = raw.reshape(*raw.shape[:2], -1)
    if (channels := raw.shape[2]) not in CONVERSIONS:
        raise InputError(path, "", f"{channels} channels", "1, 3 or 4")
    return cv2.cvtColor(raw, CONVERSIONS[channels])


def _heic(path: Path, data: bytes) -> UInt8[np.ndarray, "H W C"]:
    require("heic", "pillow_heif", purpose="the optional extra that reads HEIC photos", otherwise=", or convert them")
    import pillow_heif

    try:
        image = pillow_heif.read_heif(data, convert_hdr_to_8bit=True).to_pillow()
    except (OSError, ValueError, RuntimeError, SyntaxError, EOFError) as error:
        raise InputError(path, "", f"an unreadable image ({error})", "a whole HEIC photo", "copy it again") from error
    return np.asarray(image.convert("RGBA" if "A" in image.mode else "RGB"))


def _check_png(path: Path, data: bytes) -> None:
    """Compares the checksums of all chunks, up to the last: some OpenCV versions fill the rest with grey and only warn."""
    at, name = 8, b""
    while name != b"IEND":
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        name = data[at + 4 : at + 8]
        if len(name) < 4 or zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            raise InputError(path, "", "an image that was cut short or changed", "a whole PNG", "copy it again")
        at = end + 4
    width, height = (int.from_bytes(data[at : at + 4], "big") for at in (16, 20))
    check_memory(path, "", f"{width}x{height} pixels", 3 * width * height)
