"""The built-in scene's pictures are kept on disk, and made again where they are damaged."""

import warnings

import numpy as np
import pytest

from nerf_lightning.dataset.bricks import scene as module
from nerf_lightning.dataset.bricks.scene import bricks

TINY = {"size": 8, "train_views": 1, "val_views": 1, "orbit_views": 1}


def test_cache_round_trip(tmp_path, monkeypatch):
    folder = tmp_path / "not" / "yet"
    made = bricks(**TINY, cache=str(folder)).sha256()
    (file,) = folder.iterdir()
    assert file.suffix == ".npz"

    monkeypatch.setattr(module, "picture", lambda *_: pytest.fail("traced again"))
    assert bricks(**TINY, cache=str(folder)).sha256() == made
    # Other parameters, other file.
    with pytest.raises(pytest.fail.Exception, match="traced again"):
        bricks(**TINY | {"size": 9}, cache=str(folder))


OTHER = np.zeros((1, 2, 2, 4), np.uint8)
DAMAGE = {
    "cut": lambda file, b: file.write_bytes(b[: len(b) // 2]),
    "empty": lambda file, b: file.write_bytes(b""),
    "zeros": lambda file, b: file.write_bytes(b[:200] + b"\0" * 99 + b[299:]),
    "other shapes": lambda file, b: np.savez(file, images_train=OTHER, images_val=OTHER),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_cache_is_remade(tmp_path, damage):
    digest = bricks(**TINY, cache=str(tmp_path)).sha256()
    (file,) = tmp_path.iterdir()
    DAMAGE[damage](file, file.read_bytes())
    scene = bricks(**TINY, cache=str(tmp_path))
    assert scene.sha256() == digest
    with np.load(file, allow_pickle=False) as again:
        np.testing.assert_array_equal(again["images_train"], scene.train.images.numpy())
    assert list(tmp_path.iterdir()) == [file]


def test_unwritable_cache_warns_once(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.warns(UserWarning, match="not cached") as caught:
        assert len(bricks(**TINY, cache=str(blocked / "cache")).train) == 1
    assert len(caught) == 1


def test_failed_write_leaves_nothing(tmp_path, monkeypatch):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(module.np, "savez_compressed", full)
    with pytest.warns(UserWarning, match="no space left"):
        bricks(**TINY, cache=str(tmp_path))
    assert list(tmp_path.iterdir()) == []


def test_cache_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(tmp_path / "own"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bricks(**TINY, cache="")
        assert list(tmp_path.iterdir()) == []
        for folder, variable in (
            ("own", "NERF_LIGHTNING_CACHE"),
            ("xdg/nerf_lightning", "XDG_CACHE_HOME"),
            ("home/.cache/nerf_lightning", "HOME"),
        ):
            bricks(**TINY)
            assert len(list((tmp_path / folder).iterdir())) == 1
            if variable != "HOME":
                monkeypatch.delenv(variable)
