"""Arrays from outside: their headers are compared first, and whatever is damaged is refused in one line."""

import io
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.errors import InputError
from nerf_lightning.utils import memory
from nerf_lightning.utils.parsing import Header, read_npy, read_npz

ROWS = np.arange(6.0).reshape(2, 3)
ENTRY = b"PK\x01\x02\x14\x03\x14\x00"
"""How an entry of the directory begins; then come its flags and its kind of packing."""


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def archive(*members: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of two members of one name
        for name, content in members:
            made.writestr(name, content)
    return file.getvalue()


def with_header(text: str, data: bytes = b"") -> bytes:
    header = text.encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def told(shape: str) -> bytes:
    return with_header(f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}}}", bytes(6))


def whole(content: bytes) -> dict[str, np.ndarray]:
    return read_npz(content, None, lambda headers: None, "given.npz")


def test_arrays_are_read_and_other_entries_are_not():
    content = archive(("a.npy", npy(ROWS)), ("b.npy", b"damaged"), ("note.txt", b"hello"))
    read = read_npz(content, ("a", "c"), lambda headers: None)
    assert list(read) == ["a"] and (read["a"] == ROWS).all()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (archive(("a.npy", npy(ROWS)), ("a.npy", npy(ROWS))), "a: found two arrays of this name"),
        (archive(("a.npy", npy(ROWS)), ("a", npy(ROWS))), "a: found two arrays of this name"),
        (archive(("a", b"text")), "a: found something unreadable"),
        (archive(("a.npy", with_header("{'descr': (((, "))), "a: found something unreadable"),
        (archive(("a.npy", with_header("(" * 100))), "a: found something unreadable"),
        (archive(("a.npy", npy(ROWS)[:-1])), "a: found something unreadable (ValueError: 47 bytes for an array"),
        (archive(("a.npy", told("(10000, 10000, 10000)"))), "6 bytes for an array of shape (10000, 10000, 10000)"),
        (archive(("a.npy", told("(-2, -3)"))), "6 bytes for an array of shape (-2, -3)"),
        (archive(("a.npy", npy(ROWS))).replace(ENTRY + b"\x00\x00\x00", ENTRY + b"\x00\x00\x63"), "NotImplementedError"),
        (archive(("a.npy", npy(ROWS))).replace(ENTRY + b"\x00\x00", ENTRY + b"\x01\x00"), "RuntimeError"),  # encrypted
        (b"PK", "BadZipFile"),
        (b"no zip", "no zip archive"),
    ],
)  # fmt: skip
def test_a_damaged_archive_is_refused(content: bytes, found: str):
    with pytest.raises(InputError) as caught:
        whole(content)
    assert str(caught.value).startswith("given.npz") and found in str(caught.value)


def refuse(headers: object) -> None:
    raise InputError("given.npz", "a", str(headers), "something else")


def test_shapes_are_compared_before_anything_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("unpacked"))
    header = Header((2, 3), np.dtype(np.float64))
    with pytest.raises(InputError) as caught:
        read_npz(archive(("a.npy", npy(ROWS))), None, refuse)
    assert str(header) in str(caught.value)
    (tmp_path / "a.npy").write_bytes(npy(ROWS))
    with pytest.raises(InputError) as caught:
        read_npy(tmp_path / "a.npy", refuse)
    assert str(header) in str(caught.value)


@pytest.mark.parametrize(
    "read", [lambda path: whole(archive(("a.npy", path.read_bytes()))), lambda path: read_npy(path, lambda _: None)]
)
def test_what_unpacks_to_more_than_memory_is_refused(
    read: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (tmp_path / "a.npy").write_bytes(npy(ROWS))
    read(tmp_path / "a.npy")
    monkeypatch.setattr(memory, "free_memory", lambda *_: ROWS.nbytes - 1.0)
    with pytest.raises(InputError, match="that take at least"):
        read(tmp_path / "a.npy")
