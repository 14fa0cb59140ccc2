"""Paths as users write them, and files of which no reader ever sees half: also on a full disk, or when a process is ended."""

import errno
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nerf_lightning.errors import InputError, NoRoom, Unwritable
from nerf_lightning.utils.ending import held

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""A full disk, a quota, a limit on the size of files."""
BLOCK = 1 << 16
"""Bytes that a full disk certainly does not take: file systems have blocks of 4 to 64 KiB, and a write fills the last one."""
SHOWN = 60
"""Letters of a path that is too long which a message shows."""


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path` with the same suffix; renames it to `path` if the block succeeds.

    Raises:
        NoRoom: where there is none for the file; what stood at `path` stays.
        InputError: where a folder stands there.
        Unwritable: where nothing can be written.
    """
    if path.is_dir():
        raise InputError(path, "", "a folder", "a file to write", "give another name")
    temporary = None
    try:
        with held(), _writing_into(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.stem}-", suffix=path.suffix)
            os.close(handle)
            temporary = Path(name)
        yield temporary
        with held():
            temporary.chmod(0o666 & ~_umask())  # mkstemp makes files private; a result is an ordinary file
            os.replace(temporary, path)
    except Exception as error:
        if full_disk(error) or (temporary is not None and _takes_no_more(temporary)):
            raise no_room(path) from error
        raise
    finally:
        with held():
            if temporary is not None and temporary.exists():
                os.truncate(temporary, 0)  # gives its room back even where a writer that failed still holds it open
                temporary.unlink()


def link_file(source: Path, target: Path) -> None:
    """Gives a file a second name, which keeps its content when `source` is replaced; copies it where the file system has no
    links.

    Raises:
        NoRoom, Unwritable: see `atomic`.
    """
    if target.exists() and target.samefile(source):
        return
    temporary = target.with_name(f".{target.stem}-link{target.suffix}")
    with held():
        try:
            temporary.unlink(missing_ok=True)
            os.link(source, temporary)
            os.replace(temporary, target)
            return
        except OSError:
            pass  # no links here, or no more to this file
    with atomic(target) as copy:
        shutil.copyfile(source, copy)


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder beside `path`; replaces `path` with it if the block succeeds.

    Raises:
        NoRoom: where there is none for the files; what stood at `path` stays.
    """
    temporary = None
    try:
        with held(), _writing_into(path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}-"))
        yield temporary
        with held():
            temporary.chmod(0o777 & ~_umask())
            shutil.rmtree(path, ignore_errors=True)
            os.replace(temporary, path)
    except Exception as error:
        if full_disk(error) or (temporary is not None and _takes_no_more(temporary / "probe")):
            raise no_room(path) from error
        raise
    finally:
        with held():
            if temporary is not None:
                shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def _writing_into(folder: Path) -> Iterator[None]:
    """Tells of a folder that cannot be made, or not be written."""
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise
        found = error.strerror or str(error)
        raise Unwritable(folder, "", found, "a folder that can be written", "give another one") from error


def full_disk(error: BaseException | None) -> bool:
    """Whether an error, or one that led to it, says that a disk is full."""
    while error is not None:
        if isinstance(error, NoRoom) or (isinstance(error, OSError) and error.errno in FULL):
            return True
        error = error.__cause__ or error.__context__
    return False


def no_room(where: object) -> NoRoom:
    """The error to tell of a full disk."""
    return NoRoom(
        where, "", "no space left on the device", "room for it", "make room and go on: what stood there stays"
    )


def _takes_no_more(file: Path) -> bool:
    """Whether a file that failed to be written cannot grow: writers in C, of pictures and checkpoints, do not say why."""
    try:
        with file.open("ab") as more:
            more.write(bytes(BLOCK))
    except OSError as error:
        return error.errno in FULL
    return False


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def write_json(path: Path, content: object) -> None:
    """Writes strict JSON (no NaN), atomically."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def known(value: Any) -> Any:
    """Plain values, with null for what no finite number is, as JSON has none: figures of a field that has broken down."""
    if isinstance(value, dict):
        return {key: known(one) for key, one in value.items()}
    if isinstance(value, list):
        return [known(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def user_path(text: str | os.PathLike[str]) -> Path:
    """A path as a user writes it, perhaps with ~.

    Raises:
        InputError: for the home of a user who is not known, and for a name that no file can have.
    """
    try:
        path = Path(text).expanduser()
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            path.lstat()
    except (RuntimeError, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno != errno.ENAMETOOLONG:
            raise
        reasons = {RuntimeError: "the home of a user who is not known", ValueError: str(error)}
        reason = reasons.get(type(error), f"{len(str(text))} letters")
        written = str(text) if len(str(text)) <= SHOWN else f"{str(text)[:SHOWN]}..."
        raise InputError(repr(written), "", reason, "a path that a file or folder can have") from error
    return path


def output_path(text: str | os.PathLike[str]) -> Path:
    """As `user_path`, of something to write; whether that can be is known before any work is done.

    Raises:
        InputError: as there, and where no file can be written.
    """
    path = user_path(text)
    places = (path.absolute(), *path.absolute().parents)
    there = next(one for one in places if os.path.isdir(one) or (one != places[0] and os.path.lexists(one)))
    if not os.path.isdir(there):
        raise InputError(path, "", f"{there}, which is a file", "a folder to write into", "give another one")
    if not os.access(there, os.W_OK | os.X_OK):
        raise InputError(path, "", f"{there}, which may not be written", "a folder to write into", "give another one")
    return path


def remove_empty(folder: Path) -> None:
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
