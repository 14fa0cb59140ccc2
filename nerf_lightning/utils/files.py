"""User paths, and atomic writes of files and folders."""

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
"""Full disk, quota, file size limit."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yields a temporary file in the same folder, with the same suffix; renames it to `path` if the block succeeds.

    Raises:
        DiskFullError: the disk is full; the file at `path` stays.
        InputError: `path` is a folder.
        OSError: the folder is not writable.
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
    """As `atomic_write`, for a folder; replaces an existing one."""
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
    """Hard-links a file, so that `target` keeps its content when `source` is replaced; copies where links are unsupported."""
    with atomic_write(target) as temporary:
        temporary.unlink()
        try:
            os.link(source, temporary)
        except OSError:
            shutil.copyfile(source, temporary)


def remove_path(path: Path) -> None:
    """Removes a file or a folder with its content, if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def is_disk_full(error: BaseException | None) -> bool:
    """Whether an error or one of its causes is a full disk."""
    while error is not None:
        if isinstance(error, DiskFullError) or (isinstance(error, OSError) and error.errno in DISK_FULL_ERRNOS):
            return True
        error = error.__cause__ or error.__context__
    return False


def disk_full_error(where: object) -> DiskFullError:
    hint = "free some and continue: existing files are unchanged"
    return DiskFullError(where, "", "no space left on the device", hint=hint)


def write_text(path: Path, text: str) -> None:
    """Writes UTF-8 text atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path, content: object) -> None:
    """Writes strict JSON (no NaN) atomically."""
    write_text(path, json.dumps(content, indent=2, allow_nan=False) + "\n")


def nan_to_none(value: Any) -> Any:
    """Replaces NaN and infinity, which JSON lacks, by None in nested plain values."""
    if isinstance(value, dict):
        return {key: nan_to_none(item) for key, item in value.items()}
    if isinstance(value, list):
        return [nan_to_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def expand_user_path(text: str | os.PathLike[str]) -> Path:
    return Path(os.path.expanduser(text))


def check_output_path(text: str | os.PathLike[str]) -> Path:
    """Expands an output path and checks that it is writable, before any work is done.

    Raises:
        InputError: the folder is not writable.
    """
    path = expand_user_path(text)
    folder = path.absolute() if path.is_dir() else next(p for p in path.absolute().parents if os.path.lexists(p))
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        problem = f"{folder} {'may not be written' if folder.is_dir() else 'is a file'}"
        raise InputError(path, "", problem, hint="give another folder")
    return path


def remove_empty_folders(folder: Path) -> None:
    """Removes a folder and its parents below the current folder, as far as they are empty."""
    folder, current = folder.resolve(), Path.cwd()
    with suppress(OSError):
        while folder != current:
            folder.rmdir()
            folder = folder.parent if current in folder.parents else current


def cache_folder() -> Path:
    """The cache folder: NERF_LIGHTNING_CACHE, or `nerf_lightning` in the user's cache."""
    if folder := os.environ.get("NERF_LIGHTNING_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerf_lightning"
