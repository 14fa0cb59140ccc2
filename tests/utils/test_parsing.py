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

from nerf_lightning.errors import DiskFullError, InputError
from nerf_lightning.utils import memory
from nerf_lightning.utils.parsing import MAX_YAML_BYTES, read_json, read_npy, read_npz, read_yaml

ROWS = np.arange(6.0).reshape(2, 3)
PAIRS = ("ab", "bc", "cd", "de")
ALIASES = "a: &a [1, 1, 1, 1, 1]\n" + "".join(f"{b}: &{b} [*{a}, *{a}, *{a}]\n" for a, b in PAIRS)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (ALIASES, "alias"),
        ("[" * 5000, "RecursionError"),
        ("x" * (MAX_YAML_BYTES + 1), "bytes"),
        ("a: " + "9" * 5000, "unreadable as"),
        ("a: [1", "unreadable as"),
        ("!!python/object/apply:os.getcwd []", "unreadable as"),
    ],
)
def test_read_yaml_malformed_raises_one_line(text: str, found: str, tmp_path: Path):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(InputError, match=r"a\.yaml: .*options") as caught:
        read_yaml(tmp_path / "a.yaml", "options")
    assert found in str(caught.value) and "\n" not in str(caught.value)


def test_read_yaml_plain_values_are_read(tmp_path: Path):
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
def test_read_json_malformed_raises_one_line(text: str, found: str, tmp_path: Path):
    (tmp_path / "a.json").write_text(text, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(InputError, match=r"a\.json: unreadable as figures .*; export it again") as caught:
        read_json(tmp_path / "a.json", "figures")
    assert found in str(caught.value)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_read_json_any_utf_is_read(encoding: str, tmp_path: Path):
    (tmp_path / "a.json").write_bytes(json.dumps({"ü": [1, 2.5]}, ensure_ascii=False).encode(encoding))
    assert read_json(tmp_path / "a.json", "figures") == {"ü": [1, 2.5]}


def test_read_json_pipe_or_folder_raises_at_once(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    for name, found in (("pipe", "no such file"), ("", "found a folder")):
        with pytest.raises(InputError, match=found):
            read_json(tmp_path / name, "figures")


def encode_npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def make_zip(*members: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        for name, content in members:
            made.writestr(name, content)
    return file.getvalue()


def encode_npy_header(shape: str) -> bytes:
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(6)


def test_read_npz_other_arrays_stay_unread():
    content = make_zip(("a.npy", encode_npy(ROWS)), ("b.npy", b"damaged"), ("note.txt", b"hello"))
    read = read_npz(content, ("a", "c"))
    assert list(read) == ["a"] and (read["a"] == ROWS).all()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (make_zip(("a", b"text")), "unreadable as"),
        (make_zip(("a.npy", encode_npy(ROWS)[:-1])), "EOF"),
        (make_zip(("a.npy", encode_npy_header("(100000, 100000, 100000)"))), "allocate"),
        (make_zip(("a.npy", encode_npy(np.array([{}])))), "Object arrays"),
        (b"PK", "BadZipFile"),
    ],
)
def test_read_npz_damaged_raises(content: bytes, found: str):
    with pytest.raises(InputError, match="given.npz") as caught:
        read_npz(content, None, "given.npz")
    assert found in str(caught.value)


@pytest.mark.parametrize(
    "read",
    [
        lambda path: read_npz(make_zip(("a.npy", path.read_bytes())), None),
        read_npy,
        lambda path: read_json(path, "figures"),
    ],
)
def test_read_file_larger_than_memory_raises(read: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "a.npy").write_bytes(encode_npy(ROWS))
    monkeypatch.setattr(memory, "free_memory", lambda *_: ROWS.nbytes - 1.0)
    with pytest.raises(InputError, match="need at least"):
        read(tmp_path / "a.npy")


def test_input_error_pickled_keeps_type_and_message():
    error = DiskFullError("a.npz", "K", "nothing", "a matrix", "give one")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is DiskFullError and str(back) == str(error)
