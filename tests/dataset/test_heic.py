import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.dataset.placing.lenses import Shot, shot
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import tags

installed = pytest.mark.skipif(importlib.util.find_spec("pillow_heif") is None, reason="pillow-heif is not installed")


def write(file: Path) -> np.ndarray:
    """A smooth picture with a tag that would turn it, of which a HEIC reader has no need."""
    import pillow_heif

    picture = np.linspace(0, 255, 48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)
    exif = tags(6, "Apple", focal_35mm=26)
    pillow_heif.from_pillow(Image.fromarray(picture)).save(file, exif=exif, quality=90)
    return picture


@installed
def test_read_pixels_heic_is_upright(tmp_path: Path):
    picture = write(tmp_path / "a.HEIC")
    for upright in (True, False):
        found = read_pixels(tmp_path / "a.HEIC", upright)
        np.testing.assert_allclose(found.astype(int), np.rot90(picture, -1), atol=12)
    assert shot(tmp_path / "a.HEIC", 48, 64) == Shot(48, 64, "Apple", focal_35mm=26.0)


@installed
def test_read_pixels_truncated_heic_raises(tmp_path: Path):
    write(tmp_path / "a.heic")
    (tmp_path / "a.heic").write_bytes((tmp_path / "a.heic").read_bytes()[:-20])
    with pytest.raises(InputError, match="found an unreadable image .*, expected a whole HEIC photo; copy it again"):
        read_pixels(tmp_path / "a.heic")


def test_read_pixels_heic_without_package_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x1cftypheic" + bytes(100))
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"no such package, .* HEIC photos; pip install 'nerf_lightning\[heic\]'"):
        read_pixels(tmp_path / "a.heic")
