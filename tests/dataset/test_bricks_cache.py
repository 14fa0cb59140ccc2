"""The built-in scene's pictures are kept on disk, and made again where they are damaged."""

from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.dataset.bricks import scene as module
from nerf_lightning.dataset.bricks.scene import bricks

TINY = {"size": 8, "train_views": 1, "val_views": 1, "orbit_views": 1}


def test_bricks_cached_pictures_are_not_traced_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = bricks(**TINY, cache=str(tmp_path / "new")).sha256()
    monkeypatch.setattr(module, "picture", lambda *_: pytest.fail("traced again"))
    assert bricks(**TINY, cache=str(tmp_path / "new")).sha256() == made
    with pytest.raises(pytest.fail.Exception, match="traced again"):
        bricks(**TINY | {"size": 9}, cache=str(tmp_path / "new"))


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b[:200] + bytes(99) + b[299:]])
def test_bricks_damaged_cache_is_remade(damage, tmp_path: Path):
    digest = bricks(**TINY, cache=str(tmp_path)).sha256()
    (file,) = tmp_path.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    scene = bricks(**TINY, cache=str(tmp_path))
    assert scene.sha256() == digest and list(tmp_path.iterdir()) == [file]
    with np.load(file) as again:
        np.testing.assert_array_equal(again["images_train"], scene.train.images.numpy())


def test_bricks_unwritable_cache_warns(tmp_path: Path):
    (tmp_path / "file").write_text("in the way")
    with pytest.warns(UserWarning, match="not cached"):
        assert len(bricks(**TINY, cache=str(tmp_path / "file" / "cache")).train) == 1
