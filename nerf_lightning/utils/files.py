"""Paths as users write them, and files that are written whole or not at all."""

import errno
import json
import math
import os
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerf_lightning.errors import DiskFullError, InputError

DISK_FULL_ERRNOS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""A full disk, a quota, a limit on the size of files."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary file in the same folder, with the same suffix; renames it to `path` if the block succeeds.

    Raises:
        NoRoom: the disk is full; what was at `path` stays.
        InputError: a folder is there.
        OSError: the folder cannot be written.
    """
    if path.is_dir():
        raise InputError(path, "", "a folder", "a file to write", "give another name")
    with _temporary_sibling(path, Path.touch) as temporary:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)


@contextmanager
def atomic_write_folder(path: Path) -> Iterator[Path]:
    """As `atomic_write`, for a folder, which replaces one that is there."""
    with _temporary_sibling(path, Path.mkdir) as temporary:
        yield temporary
        shutil.rmtree(path, ignore_errors=True)
        os.replace(temporary, path)


@contextmanager
def _temporary_sibling(path: Path, create: Callable[[Path], None]) -> Iterator[Path]:
    temporary = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        create(temporary)
        yield temporary
    except Exception as error:
        if is_disk_full(error):
            raise disk_full_error(path) from error
        raise
    finally:
        with suppress(OSError):
            remove_path(temporary)


def link_file(source: Path, target: Path) -> None:
    """Gives a file a second name, which keeps its content when `source` is replaced; a copy where there are no links."""
    with atomic_write(target) as temporary:
        temporary.unlink()
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def remove_path(path: Path) -> None:
    """Removes a file, or a folder with its content, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def is_disk_full(error: BaseException | None) -> bool:
    """Whether an error, or one that led to it, says that a disk is full."""
    while error is not None:
        if isinstance(error, DiskFullError) or (isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS):
            return True
        error = error.__cause__ or error.__context__
    return False


def disk_full_error(where: object) -> DiskFullError:
    """The error for a full disk."""
    return DiskFullError(where, "", "no space left on the device", hint="free some and continue: nothing was lost")


def write_text(path: Path, text: str) -> None:
    """Writes text, atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Writes strict JSON (no NaN), atomically."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def nan_to_none(value: Any) -> Any:
    """Plain values with null for NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {key: nan_to_none(one) for key, one in value.items()}
    if isinstance(value, list):
        return [nan_to_none(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def expand_user_path(text: str | os.PathLike[str]) -> Path:
    """A path as a user writes it, with ~ expanded."""
    return Path(os.path.expanduser(text))


def check_output_path(text: str | os.PathLike[str]) -> Path:
    """As `expand_user_path`, for something to write, checked before any work is done.

    Raises:
        InputError: where no file can be written.
    """
    path = expand_user_path(text)
    folder = path.absolute() if path.is_dir() else next(p for p in path.absolute().parents if os.path.lexists(p))
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        found = f"{folder} {'may not be written' if folder.is_dir() else 'is a file'}"
        raise InputError(path, "", found, hint="give another folder")
    return path


def remove_empty_folders(folder: Path) -> None:
    """Removes a folder and, below the current one, those above it, as far as they are empty."""
    folder, here = folder.resolve(), Path.cwd()
    with suppress(OSError):
        while folder != here:
            folder.rmdir()
            folder = folder.parent if here in folder.parents else here


def cache_folder() -> Path:
    """Where this package keeps what it can make again: NERF_LIGHTNING_CACHE, or `nerf_lightning` in the user's cache."""
    if own := os.environ.get("NERF_LIGHTNING_CACHE"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerf_lightning"
