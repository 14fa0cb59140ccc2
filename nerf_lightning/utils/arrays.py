"""The one reader of arrays that come from outside: .npy and .npz, whose headers are compared before anything is unpacked.

Nothing is unpickled. A header tells an array's shape and type, and an archive how many bytes it has.
"""

import io
import lzma
import math
import tokenize
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.untrusted import NONSENSE, existing_file

AGAIN = "save or copy it again"
DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    OSError,
    tokenize.TokenError,
    SyntaxError,
    *NONSENSE,
)
"""What zipfile and NumPy raise for a damaged file: TokenError and SyntaxError for an array's header, RuntimeError for an
encrypted entry or an unknown kind of packing."""


@dataclass(frozen=True)
class Header:
    """What an array is, before it is read."""

    shape: tuple[int, ...]
    dtype: np.dtype[Any]

    @property
    def size(self) -> int:
        return math.prod(self.shape)

    @property
    def nbytes(self) -> int:
        return self.size * self.dtype.itemsize


Headers = Mapping[str, Header]


def read_npz(
    source: Path | bytes,
    known: Iterable[str] | None,
    check: Callable[[Headers], None],
    where: object = None,
    expected: str = "plain numeric arrays in a whole .npz file",
) -> dict[str, np.ndarray]:
    """The arrays of an .npz file; other entries stay unread.

    Args:
        source: the file, or its content.
        known: names of the arrays to read, as far as they are there; None reads all.
        check: gets their headers before any is unpacked, and raises InputError for what should not be.
        where: a content came from, for messages.
        expected: for messages.

    Raises:
        InputError: it is no such file, is damaged, holds pickled objects or two arrays of one name, or unpacks to more than
            fits into memory.
    """
    where = source if isinstance(source, Path) else where
    if isinstance(source, Path):
        existing_file(source)
    with _told(where, "", expected), source.open("rb") if isinstance(source, Path) else io.BytesIO(source) as file:
        if file.read(2) != b"PK":
            raise InputError(where, "", "a file that is no zip archive", expected)
        with zipfile.ZipFile(file) as archive:
            members = _members(where, archive, None if known is None else list(known))
            headers = {}
            for key, member in members.items():
                with _told(where, key, expected), archive.open(member) as stream:
                    headers[key] = _header(stream, member.file_size)
            check(headers)
            check_memory(where, "", "arrays", sum(header.nbytes for header in headers.values()))
            arrays = {}
            for key, member in members.items():
                with _told(where, key, expected), archive.open(member) as stream:
                    arrays[key] = np.lib.format.read_array(stream, allow_pickle=False)
            return arrays


def read_npy(path: Path, check: Callable[[Header], None]) -> np.ndarray:
    """The array of an .npy file; `check` gets its header before it is read.

    Raises:
        InputError: it is no such file, is damaged or cut short, or holds pickled objects.
    """
    existing_file(path)
    with _told(path, "", "an .npy array of numbers"), path.open("rb") as file:
        header = _header(file, path.stat().st_size)
        check(header)
        check_memory(path, "", "an array", header.nbytes)
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)


@contextmanager
def _told(where: object, key: str, expected: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except DAMAGED as error:
        found = f"something unreadable ({type(error).__name__}: {error})"
        raise InputError(where, key, found, expected, AGAIN) from error


def _members(where: object, archive: zipfile.ZipFile, known: list[str] | None) -> dict[str, zipfile.ZipInfo]:
    """The entry of each array."""
    members: dict[str, zipfile.ZipInfo] = {}
    for member in archive.infolist():
        key = member.filename.removesuffix(".npy")
        if known is not None and key not in known:
            continue
        if key in members:
            raise InputError(where, key, "two arrays of this name", "one of each", AGAIN)
        members[key] = member
    return members if known is None else {key: members[key] for key in known if key in members}


def _header(stream: io.BufferedIOBase | IO[bytes], size: int) -> Header:
    """An array's header, if as many bytes follow it as it tells; `size` is that of the whole file or entry."""
    version = np.lib.format.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version} of the format .npy")  # 3 only adds letters to the names of fields
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(stream)
    if dtype.hasobject:
        raise ValueError("Object arrays cannot be loaded")
    header = Header(shape, dtype)
    if min(shape, default=0) < 0 or header.nbytes != size - stream.tell():
        raise ValueError(f"{size - stream.tell()} bytes for an array of shape {shape} and type {dtype}")
    return header
