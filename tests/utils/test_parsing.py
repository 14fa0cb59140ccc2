"""Readers of JSON, YAML and arrays: damaged, absurd and malicious files get one line."""

import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.utils import memory
from nerf_lightning.utils.parsing import MAX_YAML_BYTES, read_json, read_npy, read_npz, read_yaml

ROWS = np.arange(6.0).reshape(2, 3)
ALIASES = "a: &a [1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in zip("abcd", "bcde", strict=True)
)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (ALIASES, "alias"),
        ("[" * 5000, "RecursionError"),
        ("x" * (MAX_YAML_BYTES + 1), "bytes"),
        ("a: " + "9" * 5000, "no YAML"),
        ("a: [1", "no YAML"),
        ("!!python/object/apply:os.getcwd []", "no YAML"),
    ],
)
def test_read_yaml_refuses_in_one_line(text: str, found: str, tmp_path: Path):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(InputError, match=r"a\.yaml: found .*, expected options") as caught:
        read_yaml(tmp_path / "a.yaml", "options")
    assert found in str(caught.value) and "\n" not in str(caught.value)


def test_read_yaml_reads_plain_values(tmp_path: Path):
    (tmp_path / "a.yaml").write_text("\ufeffmore: [1.5, yes, null, {a: 2}]\nbig: 0xffff\n", encoding="utf-8")
    assert read_yaml(tmp_path / "a.yaml", "options") == {"more": [1.5, True, None, {"a": 2}], "big": 0xFFFF}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[" * 100_000, "RecursionError"),
        ("[" + "9" * 5000 + "]", "ValueError"),
        ("[1", "line 1 column 3"),
        ('"\udcff"', "UnicodeDecodeError"),
    ],
)
def test_read_json_refuses_in_one_line(text: str, found: str, tmp_path: Path):
    (tmp_path / "a.json").write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(InputError, match=r"a\.json: found .*, expected figures; export it again") as caught:
        read_json(tmp_path / "a.json", "figures")
    assert found in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_read_json_reads_every_encoding(encoding: str, tmp_path: Path):
    (tmp_path / "a.json").write_bytes(json.dumps({"ü": [1, 2.5]}, ensure_ascii=False).encode(encoding))
    assert read_json(tmp_path / "a.json", "figures") == {"ü": [1, 2.5]}


def test_special_files_are_refused_without_waiting(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    for name, found in (("pipe", "nothing there"), ("", "a folder")):
        with pytest.raises(InputError, match=f"found {found}"):
            read_json(tmp_path / name, "figures")


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def archive(*members: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        for name, content in members:
            made.writestr(name, content)
    return file.getvalue()


def npy_of_shape(shape: str) -> bytes:
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(6)


def test_read_npz_reads_known_arrays_only():
    content = archive(("a.npy", npy(ROWS)), ("b.npy", b"damaged"), ("note.txt", b"hello"))
    read = read_npz(content, ("a", "c"))
    assert list(read) == ["a"] and (read["a"] == ROWS).all()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (archive(("a", b"text")), "unreadable"),
        (archive(("a.npy", npy(ROWS)[:-1])), "EOF"),
        (archive(("a.npy", npy_of_shape("(100000, 100000, 100000)"))), "allocate"),
        (archive(("a.npy", npy(np.array([{}])))), "Object arrays"),
        (b"PK", "BadZipFile"),
    ],
)
def test_read_npz_refuses_damage(content: bytes, found: str):
    with pytest.raises(InputError, match="given.npz") as caught:
        read_npz(content, None, "given.npz")
    assert found in str(caught.value)


@pytest.mark.parametrize(
    "read",
    [
        lambda path: read_npz(archive(("a.npy", path.read_bytes())), None),
        read_npy,
        lambda path: read_json(path, "figures"),
    ],
)
def test_content_larger_than_memory_is_refused(read: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.npy").write_bytes(npy(ROWS))
    monkeypatch.setattr(memory, "free_memory", lambda *_: ROWS.nbytes - 1.0)
    with pytest.raises(InputError, match="that take at least"):
        read(tmp_path / "a.npy")


def test_errors_come_back_whole_from_other_processes():
    error = NoRoom("a.npz", "K", "nothing", "a matrix", "give one")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is NoRoom and str(back) == str(error)
