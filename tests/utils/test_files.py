import json
import os
import resource
import stat
from pathlib import Path

import pytest
import torch

from nerf_lightning.errors import NoRoom
from nerf_lightning.utils.files import atomic, atomic_folder, write_json


def test_a_finished_block_replaces_the_file(tmp_path: Path):
    path = tmp_path / "new" / "a.txt"
    for content in ("first", "second"):
        with atomic(path) as temporary:
            temporary.write_text(content)
            assert temporary.parent == path.parent and temporary.suffix == ".txt" and temporary != path
            assert not path.exists() or path.read_text() == "first", "untouched until the end"
        assert path.read_text() == content
    assert list(path.parent.iterdir()) == [path]


def test_who_reads_meanwhile_reads_the_old_file_to_its_end(tmp_path: Path):
    write_json(tmp_path / "a.json", "old")
    with (tmp_path / "a.json").open() as reader:
        write_json(tmp_path / "a.json", "new")
        assert json.load(reader) == "old"


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_failed_block_leaves_nothing_behind(existing: bool, error: type[BaseException], tmp_path: Path):
    path = tmp_path / "a.txt"
    if existing:
        path.write_text("old")
    with pytest.raises(error), atomic(path) as temporary:
        temporary.write_text("half")
        raise error
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"] * existing


def test_on_a_full_disk_what_stood_there_stays_whatever_the_writer_says(tmp_path: Path):
    path, (soft, hard) = tmp_path / "a.ckpt", resource.getrlimit(resource.RLIMIT_FSIZE)
    path.write_text("old")
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, hard))
        with pytest.raises(NoRoom, match="a.ckpt: found no space left"), atomic(path) as temporary:
            torch.save(torch.zeros(5000), temporary)  # raises a RuntimeError that does not say why
        with pytest.raises(NoRoom), atomic_folder(tmp_path / "b") as folder:
            (folder / "c").write_bytes(bytes(9000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"]
    with pytest.raises(RuntimeError, match="something else"), atomic(path):
        raise RuntimeError("something else")


def test_results_are_ordinary_files(tmp_path: Path):
    mask = os.umask(0o027)
    try:
        write_json(tmp_path / "a.json", {})
        assert os.umask(0o027) == 0o027, "the mask is as before"
    finally:
        os.umask(mask)
    assert stat.S_IMODE((tmp_path / "a.json").stat().st_mode) == 0o640


def test_json_is_strict(tmp_path: Path):
    path = tmp_path / "a.json"
    write_json(path, {"a": [1, 2.5, None, "ü"]})
    assert json.loads(path.read_text()) == {"a": [1, 2.5, None, "ü"]}
    with pytest.raises(ValueError):
        write_json(path, {"a": float("nan")})
    assert json.loads(path.read_text())["a"][0] == 1 and list(tmp_path.iterdir()) == [path]
