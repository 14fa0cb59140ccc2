"""Safe readers of JSON, YAML, .npz and .npy files: one-line errors, bounded memory, no code execution."""

import io
import json
import lzma
import tokenize
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory

MAX_YAML_BYTES = 1 << 20
JSON_MEMORY_PER_BYTE = 32
"""Memory per byte of JSON: `{},` becomes 72 bytes."""
VALUE_ERRORS = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)
"""Raised by Python and libraries for invalid values in a file's content."""
DAMAGE_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, tokenize.TokenError, SyntaxError),
    *VALUE_ERRORS,
)
"""Raised by zipfile, NumPy and PyTorch for a damaged file."""


def require_file(path: Path, expected: str = "a file", missing_hint: str = "check the path") -> Path:
    """Checks that a path is a regular file: a pipe may never end."""
    if path.is_dir():
        raise InputError(path, "", "a folder", expected)
    if not path.is_file():
        raise InputError(path, "", "no such file", hint=missing_hint)
    return path


def read_file(path: Path, expected: str = "a file that can be read", memory_per_byte: float = 1) -> bytes:
    """The content of a file; `memory_per_byte` is what parsing takes.

    Raises:
        InputError: the file is missing, unreadable, or too large for free memory.
    """
    require_file(path, expected)
    try:
        check_memory(path, "", "content", path.stat().st_size * memory_per_byte)
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, "", f"cannot be read ({error})") from error


def read_json(path: Path, expected: str, hint: str = "export it again") -> Any:
    """Parses a JSON file in UTF-8, UTF-16 or UTF-32; `expected` and `hint` are for messages.

    Raises:
        InputError: as `read_file`, and for invalid JSON.
    """
    return parse_json(read_file(path, expected, JSON_MEMORY_PER_BYTE), path, expected, hint)


def parse_json(content: bytes, where: object, expected: str, hint: str = "") -> Any:
    """Parses JSON from bytes; `where` names their source in messages.

    Raises:
        InputError: invalid JSON.
    """
    try:
        return json.loads(content.decode(json.detect_encoding(content)))
    except (RecursionError, ValueError, MemoryError) as error:
        raise InputError(where, "", f"unreadable as {expected} ({type(error).__name__}: {error})", hint=hint) from error


class _PlainLoader(yaml.SafeLoader):
    """A SafeLoader without aliases: a few lines of them expand to unbounded memory."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            event = self.peek_event()
            raise yaml.YAMLError(f"line {event.start_mark.line + 1}: an alias (*{event.anchor})")
        return super().compose_node(parent, index)


def read_yaml(path: Path, expected: str, hint: str = "") -> Any:
    """Parses a YAML file into plain values; `expected` and `hint` are for messages.

    Raises:
        InputError: as `read_file`, and for invalid YAML, aliases, or more than `MAX_YAML_BYTES`.
    """
    if (size := require_file(path, expected).stat().st_size) > MAX_YAML_BYTES:
        raise InputError(path, "", f"{size} bytes", f"{expected}, of at most {MAX_YAML_BYTES} bytes", hint)
    content = read_file(path, expected)
    try:
        return yaml.load(content.decode("utf-8-sig"), _PlainLoader)  # noqa: S506  (a SafeLoader)
    except (yaml.YAMLError, *VALUE_ERRORS) as error:  # VALUE_ERRORS: invalid dates and numbers
        raise InputError(path, "", f"unreadable as {expected} ({type(error).__name__}: {error})", hint=hint) from error


def read_npz(
    source: Path | bytes,
    keys: Iterable[str] | None,
    where: object = None,
    expected: str = "plain numeric arrays in a whole .npz file",
) -> dict[str, np.ndarray]:
    """The arrays of an .npz file; other entries stay unread.

    Args:
        source: the file, or its content.
        keys: names of the arrays to read, if present; None reads all.
        where: origin of bytes, for messages.
        expected: for messages.

    Raises:
        InputError: the file is no .npz, damaged, holds pickled objects, or unpacks to more than free memory.
    """
    if isinstance(source, Path):
        where = require_file(source, expected)
    file = source if isinstance(source, Path) else io.BytesIO(source)
    with _damage_as_input_error(where, expected), zipfile.ZipFile(file) as archive:
        members = {member.filename.removesuffix(".npy"): member for member in archive.infolist()}
        names = list(members) if keys is None else [name for name in keys if name in members]
        check_memory(where, "", "arrays", sum(members[name].file_size for name in names))
        arrays = {}
        for name in names:
            with archive.open(members[name]) as stream:
                arrays[name] = np.lib.format.read_array(stream, allow_pickle=False)
        return arrays


def read_npy(path: Path) -> np.ndarray:
    """The array of an .npy file.

    Raises:
        InputError: the file is no .npy, damaged, or holds pickled objects.
    """
    require_file(path)
    check_memory(path, "", "an array", path.stat().st_size)
    with _damage_as_input_error(path, "an .npy array of numbers"), path.open("rb") as file:
        return np.lib.format.read_array(file, allow_pickle=False)


@contextmanager
def _damage_as_input_error(where: object, expected: str) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except DAMAGE_ERRORS as error:
        found = f"unreadable as {expected} ({type(error).__name__}: {error})"
        raise InputError(where, "", found, hint="save or copy it again") from error
