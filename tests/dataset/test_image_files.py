"""Decoding: JPEG at reduced scale, orientation, damaged files."""

import importlib.util
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from nerf_lightning.dataset.formats.image_files import choose_draft_scale, read_image_size, read_pixels
from nerf_lightning.dataset.resize import resize_area
from nerf_lightning.dataset.sfm.colmap import read_lens_tags
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import encode_exif


def photo(width: int, height: int) -> np.ndarray:
    """Fine detail over a ramp, without symmetry."""
    y, x = np.mgrid[:height, :width]
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 60, (height, width, 3)), (0, 0), 1.0)
    ramp = np.stack([x * 255 / width, y * 255 / height, (x + y) * 127 / (width + height)], axis=-1)
    return (ramp + noise).clip(0, 255).astype(np.uint8)


def save(path: Path, pixels: np.ndarray, orientation: int = 1) -> Path:
    Image.fromarray(pixels).save(path, quality=95, exif=encode_exif(orientation))
    return path


@pytest.mark.parametrize(("orientation", "upright"), [*((tag, True) for tag in range(1, 9)), (6, False)])
def test_read_pixels_reduced_jpeg_is_the_area_average(orientation: int, upright: bool, tmp_path: Path):
    path = save(tmp_path / "a.jpg", photo(160, 96), orientation)
    whole = read_pixels(path, upright)
    size = (40, 24) if whole.shape == (96, 160, 3) else (24, 40)
    assert read_image_size(path, upright) == (4 * size[0], 4 * size[1], False)
    reduced = read_pixels(path, upright, size)
    assert reduced.shape[1::-1] == size
    off = np.abs(reduced.astype(int) - resize_area(whole, *size))
    assert off.mean() < 2 and off.max() <= 16


def test_choose_draft_scale_leaves_enough_pixels():
    """At least two pixels per output pixel unless exact, and no partial pixels at the edge."""
    for wanted, factor in (((1008, 756), 4), ((504, 378), 8), ((500, 375), 4), ((1000, 750), 2), ((4032, 3024), 1)):
        assert choose_draft_scale(4032, 3024, wanted) == factor
    assert choose_draft_scale(4030, 3024, (1008, 756)) == 1


def test_read_pixels_damaged_image_raises(tmp_path: Path):
    path = save(tmp_path / "a.jpg", photo(64, 32))
    data = path.read_bytes()
    for content in (*(data[:kept] for kept in np.linspace(3, len(data) - 3, 10).astype(int)), b"GIF89a" + bytes(100)):
        path.write_bytes(content)
        with pytest.raises(InputError, match="no readable image") as caught:
            read_pixels(path, size=(32, 16))
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("mode", ["L", "CMYK"])
def test_read_pixels_gray_and_cmyk_become_rgb(mode: str, tmp_path: Path):
    picture = Image.fromarray(photo(32, 16)).convert(mode)
    picture.save(tmp_path / "a.jpg", quality=95)
    assert np.abs(read_pixels(tmp_path / "a.jpg").astype(int) - np.asarray(picture.convert("RGB"))).mean() < 4


@pytest.mark.skipif(importlib.util.find_spec("pillow_heif") is None, reason="pillow-heif is not installed")
def test_read_pixels_heic_is_upright(tmp_path: Path):
    """A smooth picture with an orientation tag, which a HEIC reader must ignore."""
    import pillow_heif

    file, picture = tmp_path / "a.HEIC", np.linspace(0, 255, 48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)
    exif = encode_exif(6, "Apple", focal_35mm=26)
    pillow_heif.from_pillow(Image.fromarray(picture)).save(file, exif=exif, quality=90)
    for upright in (True, False):
        np.testing.assert_allclose(read_pixels(file, upright).astype(int), np.rot90(picture, -1), atol=12)
    assert b"Apple" in read_lens_tags(file)
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(InputError, match="no readable image .*; copy it again"):
        read_pixels(file)


def test_read_pixels_heic_without_package_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x1cftypheic" + bytes(100))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"not installed: .* HEIC photos; pip install 'nerf_lightning\[heic\]'"):
        read_pixels(tmp_path / "a.heic")
