"""Files are written whole or not at all, and paths are checked before any work is done."""

import json
import os
import resource
from pathlib import Path

import pytest
import torch

from nerf_lightning.callbacks.checkpoints import AtomicCheckpointIO
from nerf_lightning.errors import DiskFullError, InputError
from nerf_lightning.utils.files import (
    atomic_write,
    atomic_write_folder,
    check_output_path,
    link_file,
    remove_empty_folders,
    write_json,
)


def test_atomic_write_success_replaces_file_at_end(tmp_path: Path):
    path = tmp_path / "new" / "a.txt"
    for content in ("first", "second"):
        with atomic_write(path) as temporary:
            temporary.write_text(content)
            assert temporary.parent == path.parent and temporary.suffix == ".txt" and temporary != path
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == content
    assert list(path.parent.iterdir()) == [path]
    with pytest.raises(InputError, match="a folder"), atomic_write(path.parent):
        pass


@pytest.mark.parametrize("kind", [atomic_write, atomic_write_folder])
def test_atomic_write_failed_keeps_existing_files(kind, tmp_path: Path):
    for name in ("first", "second"):
        with atomic_write_folder(tmp_path / "made") as folder:
            (folder / name).touch()
    with pytest.raises(KeyboardInterrupt), kind(tmp_path / "made.txt"):
        raise KeyboardInterrupt
    assert [str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*")] == ["made", "made/second"]


def test_atomic_write_full_disk_raises_and_keeps_file(tmp_path: Path):
    path, (soft, hard) = tmp_path / "a.ckpt", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("old")
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
        with pytest.raises(DiskFullError, match="a.ckpt: no space left"):
            AtomicCheckpointIO().save_checkpoint({"weights": torch.zeros(5000)}, path)
        with pytest.raises(DiskFullError), atomic_write_folder(tmp_path / "b") as folder:
            (folder / "c").write_bytes(bytes(9000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"]


def test_link_file_source_replaced_keeps_content(tmp_path: Path):
    last, best = tmp_path / "last.txt", tmp_path / "best.txt"
    best.write_text("old")
    write_json(last, "one")
    for _ in range(2):
        link_file(last, best)
    assert best.samefile(last)
    write_json(last, "two")
    assert json.loads(best.read_text()) == "one" and json.loads(last.read_text()) == "two"
    assert sorted(tmp_path.iterdir()) == [best, last]


def test_write_json_nan_raises(tmp_path: Path):
    path = tmp_path / "a.json"
    write_json(path, {"a": [1, 2.5, None, "ü"]})
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": [1, 2.5, None, "ü"]} and list(tmp_path.iterdir()) == [path]


def test_check_output_path_not_writable_raises(tmp_path: Path, monkeypatch):
    (tmp_path / "file").touch()
    assert check_output_path(tmp_path) == tmp_path
    assert check_output_path(tmp_path / "new" / "film.gif") == tmp_path / "new" / "film.gif"
    with pytest.raises(InputError, match="is a file"):
        check_output_path(tmp_path / "file" / "film.gif")
    monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != tmp_path)  # for root, all may be written
    with pytest.raises(InputError, match="may not be written"):
        check_output_path(tmp_path / "new" / "film.gif")


def test_remove_empty_folders_stops_at_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a" / "b" / "c").mkdir(parents=True)
    (tmp_path / "a" / "d").touch()
    remove_empty_folders(Path("a/b/c"))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["d"]
