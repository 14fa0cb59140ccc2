import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import builtin_picture, from_picture, load_picture
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.errors import InputError

RED, BLUE = (255, 0, 0), (0, 0, 255)


def png(path: Path, samples: np.ndarray, colour_type: int, depth: int) -> Path:
    """Writes a PNG by hand: OpenCV cannot write all kinds. `samples` is (H, W, C) in big-endian of `depth` bits."""
    height, width = samples.shape[:2]

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", width, height, depth, colour_type, 0, 0, 0)
    rows = b"".join(b"\0" + row.astype(f">u{depth // 8}").tobytes() for row in samples)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    )
    return path


@pytest.fixture
def red_then_blue() -> np.ndarray:
    """(32, 64, 3), RGB: the left half red, the right half blue."""
    picture = np.zeros((32, 64, 3), np.uint8)
    picture[:, :32], picture[:, 32:] = RED, BLUE
    return picture


def write_rgb(path: Path, picture: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), picture[..., ::-1])
    return path


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_lossless_files_come_back_as_rgb(suffix: str, red_then_blue: np.ndarray, tmp_path: Path):
    picture = load_picture(write_rgb(tmp_path / f"a.{suffix}", red_then_blue))
    assert picture.dtype == torch.uint8 and (picture.numpy() == red_then_blue).all()


def test_jpeg(red_then_blue: np.ndarray, tmp_path: Path):
    picture = load_picture(write_rgb(tmp_path / "a.jpg", red_then_blue)).int()
    assert (picture[5, 5] - torch.tensor(RED)).abs().max() < 8 and (picture[5, 60] - torch.tensor(BLUE)).abs().max() < 8


def jpeg_with_orientation(path: Path, picture: np.ndarray, orientation: int) -> Path:
    write_rgb(path, picture)
    data = path.read_bytes()
    # TIFF header, one entry: tag 0x0112 (orientation), type 3 (short), count 1; then no next directory.
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
    body = b"Exif\0\0" + tiff
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
    return path


@pytest.mark.parametrize(("orientation", "red_corner"), [(1, (5, 5)), (3, (5, 60)), (6, (5, 5)), (8, (60, 5))])
def test_exif_rotation(orientation: int, red_corner: tuple[int, int], red_then_blue: np.ndarray, tmp_path: Path):
    """6 turns the picture a quarter clockwise: left becomes top. 8 turns it back: left becomes bottom."""
    path = jpeg_with_orientation(tmp_path / "a.jpg", red_then_blue, orientation)
    picture = load_picture(path)
    assert picture.shape == ((64, 32, 3) if orientation in (6, 8) else (32, 64, 3))
    assert (picture[red_corner].int() - torch.tensor(RED)).abs().max() < 8
    # Posed photos are read as stored: their intrinsics speak of those pixels.
    stored = read_pixels(path)
    assert stored.shape == (32, 64, 3) and stored[5, 5, 0] > 240


def test_exif_rotation_of_greyscale(tmp_path: Path):
    path = tmp_path / "grey.jpg"
    cv2.imwrite(str(path), np.zeros((32, 64), np.uint8))
    data = path.read_bytes()
    body = b"Exif\0\0II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[2:])
    assert load_picture(path).shape == (64, 32, 3)


RAMP = np.arange(256).reshape(16, 16, 1)
KINDS = {
    "grey": (RAMP, 0, 8, RAMP),
    "grey 16 bit": (RAMP * 257, 0, 16, RAMP),
    "rgb 16 bit": (np.concatenate([RAMP, RAMP[::-1], RAMP * 0], 2) * 257, 2, 16, (RAMP, RAMP[::-1], RAMP * 0)),
    "grey and alpha": (np.concatenate([RAMP * 0, RAMP], 2), 4, 8, 255 - RAMP),
    "rgba": (
        np.concatenate([RAMP * 0 + 255, RAMP * 0, RAMP * 0, RAMP], 2),
        6,
        8,
        (RAMP * 0 + 255, 255 - RAMP, 255 - RAMP),
    ),
    "rgba 16 bit": (np.concatenate([RAMP * 0] * 3 + [RAMP * 257], 2), 6, 16, 255 - RAMP),
}


@pytest.mark.parametrize("kind", KINDS)
def test_kinds_of_png(kind: str, tmp_path: Path):
    """Any depth and channel count becomes 8-bit RGB; alpha lies over white."""
    samples, colour_type, depth, expected = KINDS[kind]
    expected = np.concatenate(expected if isinstance(expected, tuple) else [expected] * 3, axis=2)
    picture = load_picture(png(tmp_path / "a.png", samples, colour_type, depth))
    assert np.abs(picture.numpy().astype(int) - expected).max() <= (1 if "16" in kind else 0)


def test_max_side_averages(tmp_path: Path):
    stripes = np.zeros((20, 40, 3), np.uint8)
    stripes[:, ::2] = 200
    path = str(write_rgb(tmp_path / "a.png", stripes))
    picture = from_picture(path, max_side=20).scene.image
    assert picture.shape == (10, 20, 3) and (picture == 100).all()
    assert from_picture(path, max_side=99).scene.image.shape == (20, 40, 3)


def test_truncated_jpeg_with_a_whole_thumbnail(red_then_blue: np.ndarray, tmp_path: Path):
    """An end marker inside the EXIF segment is not the photo's own."""
    path = write_rgb(tmp_path / "a.jpg", red_then_blue)
    data = path.read_bytes()
    thumbnail = b"\xff\xe2" + struct.pack(">H", len(data) + 2) + data
    path.write_bytes(data[:2] + thumbnail + data[2:])
    assert load_picture(path).shape == (32, 64, 3)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match="found a truncated image"):
        load_picture(path)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-30])


DAMAGE = {
    "missing": (Path.unlink, "found nothing there"),
    "folder": (lambda path: (path.unlink(), path.mkdir()), "found a folder"),
    "empty": (lambda path: path.write_bytes(b""), "found 0 bytes that are no image"),
    "text": (lambda path: path.write_text("hello"), "found 5 bytes that are no image"),
    "truncated": (_cut, "found a truncated image"),
}


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("damage", DAMAGE)
def test_damage(damage: str, suffix: str, red_then_blue: np.ndarray, tmp_path: Path, says: Callable):
    path = write_rgb(tmp_path / f"a.{suffix}", red_then_blue)
    spoil, words = DAMAGE[damage]
    spoil(path)
    with pytest.raises(InputError) as caught:
        load_picture(path)
    says(caught.value, path, words, ", expected ")


def test_float_pixels_are_refused(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "a.tiff"), np.zeros((4, 4, 3), np.float32))
    with pytest.raises(InputError, match="float32 pixels, expected 8 or 16 bits"):
        load_picture(tmp_path / "a.tiff")


def test_builtin_picture_is_deterministic_and_rich():
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


@pytest.mark.real_data
def test_real_pictures(real_data: Path):
    shapes = {path.name: tuple(load_picture(path).shape) for path in (real_data / "images").iterdir()}
    assert shapes == {
        "airplane.tiff": (512, 512, 3),
        "peppers.tiff": (512, 512, 3),
        "kodim23_gray.png": (512, 768, 3),
    }
