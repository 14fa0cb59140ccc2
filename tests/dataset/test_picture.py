import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import builtin_picture, from_picture, load_picture
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.errors import InputError

RED, BLUE = (255, 0, 0), (0, 0, 255)


@pytest.fixture
def red_then_blue() -> np.ndarray:
    """(32, 64, 3), RGB: the left half red, the right half blue."""
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:, :32], picture[:, 32:] = RED, BLUE
    return picture


def write(path: Path, picture: np.ndarray) -> Path:
    """Any depth; grey, grey and alpha (8 bits), RGB or RGBA."""
    if picture.shape[-1] == 2:
        imageio.imwrite(path, picture)
    else:
        assert cv2.imwrite(
            str(path), picture[..., [2, 1, 0, 3][: picture.shape[-1]]] if picture.shape[-1] > 2 else picture
        )
    return path


@pytest.mark.parametrize(("suffix", "error"), [("png", 0), ("tiff", 0), ("jpg", 7)])
def test_load_picture_formats_return_rgb(suffix: str, error: int, red_then_blue: np.ndarray, tmp_path: Path):
    picture = load_picture(write(tmp_path / f"a.{suffix}", red_then_blue))
    assert picture.dtype == torch.uint8
    assert np.abs(picture[:, ::59].numpy().astype(int) - red_then_blue[:, ::59]).max() <= error


def jpeg_with_orientation(path: Path, picture: np.ndarray, orientation: int) -> Path:
    data = write(path, picture).read_bytes()
    # TIFF header, one entry: tag 0x0112 (orientation), type 3 (short), count 1; then no next directory.
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    body = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
    return path


@pytest.mark.parametrize(("orientation", "red_corner"), [(1, (5, 5)), (3, (5, 60)), (6, (5, 5)), (8, (60, 5))])
def test_load_picture_exif_orientation_is_applied(
    orientation: int, red_corner: tuple[int, int], red_then_blue: np.ndarray, tmp_path: Path
):
    """6 turns the picture a quarter clockwise: left becomes top. 8 turns it back: left becomes bottom."""
    path = jpeg_with_orientation(tmp_path / "a.jpg", red_then_blue, orientation)
    picture = load_picture(path)
    assert picture.shape == ((64, 32, 3) if orientation in (6, 8) else (32, 64, 3))
    assert (picture[red_corner].int() - torch.tensor(RED)).abs().max() < 8
    # Posed photos are read as stored: their intrinsics speak of those pixels.
    stored = read_pixels(path)
    assert stored.shape == (32, 64, 3) and stored[5, 5, 0] > 240


RAMP = np.arange(256, dtype=np.uint16).reshape(16, 16, 1)
NONE, FULL, WHITE_UNDER = RAMP * 0, RAMP * 0 + 255, 255 - RAMP
KINDS = {
    "grey": ([RAMP], [RAMP] * 3),
    "rgb": ([RAMP, RAMP[::-1], NONE], [RAMP, RAMP[::-1], NONE]),
    "grey and alpha": ([NONE, RAMP], [WHITE_UNDER] * 3),
    "rgba": ([FULL, NONE, NONE, RAMP], [FULL, WHITE_UNDER, WHITE_UNDER]),
}


@pytest.mark.parametrize(
    ("kind", "bits"), [(kind, bits) for kind in KINDS for bits in (8, 16) if (kind, bits) != ("grey and alpha", 16)]
)
def test_load_picture_png_kinds_become_rgb8(kind: str, bits: int, tmp_path: Path):
    """Any depth and channel count becomes 8-bit RGB; alpha lies over white."""
    samples, expected = (np.concatenate(channels, axis=2) for channels in KINDS[kind])
    path = write(tmp_path / "a.png", samples.astype(np.uint8) if bits == 8 else samples * 257)
    assert np.abs(load_picture(path).numpy().astype(int) - expected).max() <= (1 if bits == 16 else 0)


def test_from_picture_max_side_averages(tmp_path: Path):
    stripes = np.zeros((20, 40, 3), np.uint8)
    stripes[:, ::2] = 200
    path = str(write(tmp_path / "a.png", stripes))
    picture = from_picture(path, max_side=20).scene.image
    assert picture.shape == (10, 20, 3) and (picture == 100).all()
    assert from_picture(path, max_side=99).scene.image.shape == (20, 40, 3)


def test_load_picture_truncated_jpeg_with_thumbnail_raises(red_then_blue: np.ndarray, tmp_path: Path):
    """An end marker inside the EXIF segment is not the photo's own."""
    path = write(tmp_path / "a.jpg", red_then_blue)
    data = path.read_bytes()
    thumbnail = b"\xff\xe2" + struct.pack(">H", len(data) + 2) + data
    path.write_bytes(data[:2] + thumbnail + data[2:])
    assert load_picture(path).shape == (32, 64, 3)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match="found an image that was cut short"):
        load_picture(path)


DAMAGE = {
    "missing": (Path.unlink, "found nothing there"),
    "folder": (lambda path: (path.unlink(), path.mkdir()), "found a folder"),
    "empty": (lambda path: path.write_bytes(b""), "found 0 bytes that are no image"),
    "text": (lambda path: path.write_text("hello"), "found 5 bytes that are no image"),
    "truncated": (lambda path: path.write_bytes(path.read_bytes()[:-30]), "found an image that was cut short"),
}


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_load_picture_damaged_file_raises(
    damage: str, suffix: str, red_then_blue: np.ndarray, tmp_path: Path, says: Callable
):
    path = write(tmp_path / f"a.{suffix}", red_then_blue)
    spoil, words = DAMAGE[damage]
    spoil(path)
    with pytest.raises(InputError) as caught:
        load_picture(path)
    says(caught.value, path, words, ", expected ")


def test_load_picture_float_pixels_raise(tmp_path: Path):
    path = write(tmp_path / "a.tiff", np.zeros((4, 4, 3), np.float32))
    with pytest.raises(InputError, match="float32 pixels, expected 8 or 16 bits"):
        load_picture(path)


def test_builtin_picture_is_deterministic_and_detailed():
    picture = builtin_picture(128)
    assert picture.shape == (128, 128, 3) and picture.dtype == torch.uint8
    assert torch.equal(picture, builtin_picture(128))
    values = picture.float()
    assert (values.std((0, 1)) > 20).all()  # colourful in every channel
    # Detail at all scales: halving the resolution and back loses something, but not much.
    coarse = values.view(64, 2, 64, 2, 3).mean((1, 3)).repeat_interleave(2, 0).repeat_interleave(2, 1)
    assert 2 < (values - coarse).square().mean().sqrt() < 20
    # Going down a column, brightness hardly ever turns in the sky, often in the water, most often at the horizon.
    slope = values.mean(-1).diff(dim=0)
    turns = (slope[1:] * slope[:-1] < -1).float().mean(1)
    assert turns[:30].mean() < 0.02 and turns[82:94].mean() > 1.5 * turns[110:125].mean() > 0.2


def test_load_picture_changed_png_raises(tmp_path: Path):
    path = tmp_path / "a.png"
    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8))
    whole = path.read_bytes()
    for at in range(8, len(whole)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
        with pytest.raises(InputError, match="cut short or changed"):
            load_picture(path)
