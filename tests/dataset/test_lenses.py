from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from nerf_lightning.dataset.placing.lenses import Shot, focal_pixels, shot
from tests.helpers.exif_tags import tags

CANON = {"make": "Canon", "model": "Canon EOS 5D Mark II"}


def photo(folder: Path, exif: bytes) -> Path:
    Image.new("RGB", (60, 40)).save(folder / "a.jpg", exif=exif)
    return folder / "a.jpg"


@pytest.mark.parametrize(
    ("exif", "known", "pixels"),
    [
        ({}, {}, None),
        ({"focal_35mm": 26}, {"focal_35mm": 26.0}, 26 / np.hypot(36, 24) * np.hypot(600, 400)),
        ({"focal": 50.0, **CANON}, {"focal": 50.0, **CANON}, 600 * 50 / 36),  # a sensor as wide as film
        ({"focal": 50.0, "make": "Nobody", "model": "X"}, {"focal": 50.0, "make": "Nobody", "model": "X"}, None),
        ({"focal": 50.0}, {"focal": 50.0}, None),
        ({"focal_35mm": 1}, {"focal_35mm": 1.0}, None),
        ({"focal_35mm": 3000}, {"focal_35mm": 3000.0}, None),
        ({"focal": IFDRational(50, 0), "make": " A\0  B "}, {"make": "A B"}, None),
    ],
)
def test_focal_pixels_exif_gives_focal(exif: dict, known: dict, pixels: float | None, tmp_path: Path):
    found = shot(photo(tmp_path, tags(**exif)), 600, 400)
    assert found == Shot(600, 400, **known)
    assert focal_pixels(found) == (None if pixels is None else pytest.approx(pixels, rel=1e-3))


def test_shot_zoom_is_another_lens(tmp_path: Path):
    wide, far = (shot(photo(tmp_path, tags(focal_35mm=focal, **CANON)), 600, 400) for focal in (26, 52))
    assert wide != far and wide == shot(photo(tmp_path, tags(focal_35mm=26, **CANON)), 600, 400)
    assert wide != shot(photo(tmp_path, tags(focal_35mm=26, **CANON)), 400, 600)
