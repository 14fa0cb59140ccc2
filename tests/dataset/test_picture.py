from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from nerf_lightning.dataset import load_picture, make_builtin_picture
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import encode_exif

RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.fixture
def red_then_blue() -> np.ndarray:
    """(32, 64, 3), RGB: the left half red, the right half blue."""
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:, :32], picture[:, 32:] = RED, BLUE
    return picture


def write(path: Path, picture: np.ndarray) -> Path:
    """Any depth; gray, gray and alpha (8 bits), RGB or RGBA."""
    if picture.shape[-1] == 2:
        imageio.imwrite(path, picture)
    else:
        kinds = picture.shape[-1]
        assert cv2.imwrite(str(path), picture[..., [2, 1, 0, 3][:kinds]] if kinds > 2 else picture)
    return path


def test_load_picture_formats_return_rgb(red_then_blue: np.ndarray, tmp_path: Path):
    for suffix, error in (("png", 0), ("tiff", 0), ("jpg", 7)):
        picture = load_picture(write(tmp_path / f"a.{suffix}", red_then_blue))
        assert picture.dtype == torch.uint8
        assert np.abs(picture[:, ::59].numpy().astype(int) - red_then_blue[:, ::59]).max() <= error


@pytest.mark.parametrize(("orientation", "red_corner"), [(3, (5, 60)), (8, (60, 5))])
def test_load_picture_exif_orientation_is_applied(
    orientation: int, red_corner: tuple[int, int], red_then_blue: np.ndarray, tmp_path: Path
):
    """8 rotates by 90 degrees: left becomes bottom."""
    path = tmp_path / "a.jpg"
    Image.fromarray(red_then_blue).save(path, quality=95, exif=encode_exif(orientation))
    picture = load_picture(path)
    assert picture.shape == ((64, 32, 3) if orientation == 8 else (32, 64, 3))
    assert (picture[red_corner].int() - torch.tensor(RED)).abs().max() < 8
    # Posed photos are read as stored: their intrinsics refer to those pixels.
    stored = read_pixels(path)
    assert stored.shape == (32, 64, 3) and stored[5, 5, 0] > 240


RAMP = np.arange(256, dtype=np.uint16).reshape(16, 16, 1)
NONE, FULL, WHITE_UNDER = RAMP * 0, RAMP * 0 + 255, 255 - RAMP
KINDS = {
    "gray": ([RAMP], [RAMP] * 3),
    "rgb": ([RAMP, RAMP[::-1], NONE], [RAMP, RAMP[::-1], NONE]),
    "gray and alpha": ([NONE, RAMP], [WHITE_UNDER] * 3),
    "rgba": ([FULL, NONE, NONE, RAMP], [FULL, WHITE_UNDER, WHITE_UNDER]),
}


@pytest.mark.parametrize(
    ("kind", "bits"), [(kind, bits) for kind in KINDS for bits in (8, 16) if (kind, bits) != ("gray and alpha", 16)]
)
def test_load_picture_png_kinds_become_rgb8(kind: str, bits: int, tmp_path: Path):
    """Any depth and channel count becomes 8-bit RGB; alpha lies over white."""
    samples, expected = (np.concatenate(channels, axis=2) for channels in KINDS[kind])
    path = write(tmp_path / "a.png", samples.astype(np.uint8) if bits == 8 else samples * 257)
    assert np.abs(load_picture(path).numpy().astype(int) - expected).max() <= (1 if bits == 16 else 0)


def test_load_picture_float_pixels_raise(tmp_path: Path):
    path = write(tmp_path / "a.tiff", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(InputError, match="a.tiff: no readable image"):
        load_picture(path)


def test_builtin_picture_is_deterministic_and_detailed():
    picture = make_builtin_picture(128)
    assert picture.shape == (128, 128, 3) and picture.dtype == torch.uint8
    assert torch.equal(picture, make_builtin_picture(128))
    assert (picture.float().std((0, 1)) > 20).all(), "colorful in every channel"


def test_load_picture_changed_png_raises(tmp_path: Path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8))
    whole = path.read_bytes()
    for at in range(8, len(whole) - 12):  # all but the IEND chunk
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        with pytest.raises(InputError, match="no readable image"):
            load_picture(path)
