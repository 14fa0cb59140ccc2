import json
import os
import resource
import stat
from pathlib import Path

import pytest
import torch

from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.utils.files import (
    atomic,
    atomic_folder,
    link_file,
    output_path,
    remove_empty,
    user_path,
    write_json,
)


def test_a_finished_block_replaces_the_file(tmp_path: Path):
    path = tmp_path / "new" / "a.txt"
    for content in ("first", "second"):
        with atomic(path) as temporary:
            temporary.write_text(content)
            assert temporary.parent == path.parent and temporary.suffix == ".txt" and temporary != path
            assert not path.exists() or path.read_text() == "first", "untouched until the end"
        assert path.read_text() == content
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("links", [True, False])
def test_a_second_name_keeps_its_content(links: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    last, best = tmp_path / "last.txt", tmp_path / "best.txt"
    best.write_text("old")
    write_json(last, "one")
    if not links:

        def refuse(*_: object) -> None:
            raise OSError("no links here")

        monkeypatch.setattr(os, "link", refuse)
    for _ in range(2):
        link_file(last, best)
    assert best.samefile(last) == links
    write_json(last, "two")
    assert json.loads(best.read_text()) == "one" and json.loads(last.read_text()) == "two"
    assert sorted(tmp_path.iterdir()) == [best, last]


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


def test_paths_as_users_write_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    assert user_path("~/photos") == tmp_path / "photos" and user_path("a/b") == Path("a/b")
    assert output_path(tmp_path / "new" / "film.gif") == tmp_path / "new" / "film.gif"
    assert output_path(tmp_path) == tmp_path


@pytest.mark.parametrize(
    ("name", "found"),
    [("~nosuchuser/a", "a user who is not known"), ("a" * 5000, "found 5000 letters"), ("a\0b", "null byte")],
)
def test_a_path_that_can_be_none_is_told_in_a_line(name: str, found: str):
    with pytest.raises(InputError, match=found) as told:
        user_path(name)
    assert len(str(told.value)) < 200


@pytest.mark.parametrize("forbidden", [False, True])
def test_where_nothing_can_be_written_is_known_beforehand(
    forbidden: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "file").touch()
    if forbidden:
        monkeypatch.setattr(os, "access", lambda place, mode: Path(place) != tmp_path)  # for root, all may be written
    with pytest.raises(InputError, match="may not be written" if forbidden else "which is a file"):
        output_path(tmp_path / ("new/film.gif" if forbidden else "file/film.gif"))


def test_empty_folders_are_removed_up_to_the_current_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a" / "b" / "c").mkdir(parents=True)
    (tmp_path / "a" / "d").touch()
    remove_empty(Path("a/b/c"))
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["d"]


def test_a_folder_is_not_replaced_by_a_file(tmp_path: Path):
    with pytest.raises(InputError, match="found a folder, expected a file to write"), atomic(tmp_path):
        pass
    assert list(tmp_path.iterdir()) == []
