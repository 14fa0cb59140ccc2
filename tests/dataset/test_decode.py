"""Decoding: JPEG at reduced scale, legal oddities, files cut short, headers."""

import importlib.util
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from nerf_lightning.dataset.formats.decode import draft_scale, image_header, read_pixels
from nerf_lightning.dataset.resize import area_resize
from nerf_lightning.dataset.sfm.colmap import lens_tags
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import tags


def photo(width: int, height: int) -> np.ndarray:
    """Fine detail over a ramp, not the same when turned or flipped."""
    y, x = np.mgrid[:height, :width]
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 60, (height, width, 3)), (0, 0), 1.0)
    ramp = np.stack([x * 255 / width, y * 255 / height, (x + y) * 127 / (width + height)], axis=-1)
    return (ramp + noise).clip(0, 255).astype(np.uint8)


def save(path: Path, pixels: np.ndarray, orientation: int = 1) -> Path:
    Image.fromarray(pixels).save(path, quality=95, exif=tags(orientation))
    return path


def _png_chunk(name: bytes, content: bytes) -> bytes:
    return len(content).to_bytes(4, "big") + name + content + zlib.crc32(name + content).to_bytes(4, "big")


PNG_WITHOUT_ROWS = (
    b"\x89PNG\r\n\x1a\n"
    + _png_chunk(b"IHDR", bytes([0, 0, 0, 24, 0, 0, 0, 0, 8, 2, 0, 0, 0]))
    + _png_chunk(b"IEND", b"")
)


@pytest.mark.parametrize(("orientation", "upright"), [*((tag, True) for tag in range(1, 9)), (6, False)])
def test_read_pixels_reduced_jpeg_is_the_area_average(orientation: int, upright: bool, tmp_path: Path):
    path = save(tmp_path / "a.jpg", photo(160, 96), orientation)
    whole = read_pixels(path, upright)
    size = (40, 24) if whole.shape == (96, 160, 3) else (24, 40)
    assert image_header(path, upright) == (4 * size[0], 4 * size[1], False)
    reduced = read_pixels(path, upright, size)
    assert reduced.shape[1::-1] == size
    off = np.abs(reduced.astype(int) - area_resize(whole, *size))
    assert off.mean() < 2 and off.max() <= 16


@pytest.mark.parametrize(
    ("size", "wanted", "factor"),
    [
        ((4032, 3024), (1008, 756), 4),
        ((4032, 3024), (504, 378), 8),
        ((4032, 3024), (500, 375), 4),  # two pixels for each at least, where it is no exact fraction
        ((4032, 3024), (1000, 750), 2),
        ((4030, 3024), (1008, 756), 1),  # reduced, it would end beside the pixel grid
        ((4032, 3024), (4032, 3024), 1),
    ],
)
def test_draft_scale_keeps_enough_pixels(size: tuple[int, int], wanted: tuple[int, int], factor: int):
    assert draft_scale(*size, wanted) == factor


def test_read_pixels_fill_bytes_are_skipped(tmp_path: Path):
    """ITU-T T.81, B.1.1.2: any marker may be preceded by any number of bytes 0xFF."""
    path = save(tmp_path / "a.jpg", photo(32, 16))
    before, data = read_pixels(path), path.read_bytes()
    tables = data.index(b"\xff\xdb")
    path.write_bytes(data[:2] + b"\xff" * 3 + data[2:tables] + b"\xff" * 2 + data[tables:])
    assert np.array_equal(read_pixels(path), before)


def test_read_pixels_truncated_jpeg_raises(tmp_path: Path):
    path = save(tmp_path / "a.jpg", photo(64, 32))
    data = path.read_bytes()
    for kept in np.linspace(3, len(data) - 3, 10).astype(int):
        path.write_bytes(data[:kept])
        with pytest.raises(InputError, match="cut short or changed") as caught:
            read_pixels(path, size=(32, 16))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", ["L", "CMYK"])
def test_read_pixels_grey_and_cmyk_become_rgb(mode: str, tmp_path: Path):
    picture = Image.fromarray(photo(32, 16)).convert(mode)
    picture.save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_pixels(tmp_path / "a.jpg").astype(int) - np.asarray(picture.convert("RGB"))).mean() < 4


@pytest.mark.parametrize("data", [b"GIF89a" + bytes(100), PNG_WITHOUT_ROWS], ids=["gif", "png"])
def test_read_pixels_of_no_image_prints_nothing_of_opencv(
    data: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
):
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(InputError, match="no image"):
        read_pixels(tmp_path / "a.jpg")
    assert capfd.readouterr() == ("", "")


installed = pytest.mark.skipif(importlib.util.find_spec("pillow_heif") is None, reason="pillow-heif is not installed")


def write_heic(file: Path) -> np.ndarray:
    """A smooth picture with a tag that would turn it, of which a HEIC reader has no need."""
    import pillow_heif

    picture = np.linspace(0, 255, 48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)
    exif = tags(6, "Apple", focal_35mm=26)
    pillow_heif.from_pillow(Image.fromarray(picture)).save(file, exif=exif, quality=90)
    return picture


@installed
def test_read_pixels_heic_is_upright(tmp_path: Path):
    picture = write_heic(tmp_path / "a.HEIC")
    for upright in (True, False):
        found = read_pixels(tmp_path / "a.HEIC", upright)
        np.testing.assert_allclose(found.astype(int), np.rot90(picture, -1), atol=12)
    assert b"Apple" in lens_tags(tmp_path / "a.HEIC")


@installed
def test_read_pixels_truncated_heic_raises(tmp_path: Path):
    write_heic(tmp_path / "a.heic")
    (tmp_path / "a.heic").write_bytes((tmp_path / "a.heic").read_bytes()[:-20])
    with pytest.raises(InputError, match="found an unreadable image .*, expected a whole HEIC photo; copy it again"):
        read_pixels(tmp_path / "a.heic")


def test_read_pixels_heic_without_package_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x1cftypheic" + bytes(100))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"no such package, .* HEIC photos; pip install 'nerf_lightning\[heic\]'"):
        read_pixels(tmp_path / "a.heic")
