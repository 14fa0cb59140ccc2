"""Writing files so that no reader ever sees half of one, also where the disk is full or the process is asked to end."""

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerf_lightning.errors import NoRoom
from nerf_lightning.utils.ending import held

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
"""A full disk, a quota, a limit on the size of files."""
BLOCK = 1 << 16
"""Bytes that a full disk certainly does not take: file systems have blocks of 4 to 64 KiB, and a write fills the last one."""


@contextmanager
def atomic(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path` with the same suffix; renames it to `path` if the block succeeds.

    Raises:
        NoRoom: where there is none for the file; what stood at `path` stays.
    """
    temporary = None
    try:
        with held():
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


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Yields a temporary folder beside `path`; replaces `path` with it if the block succeeds.

    Raises:
        NoRoom: where there is none for the files; what stood at `path` stays.
    """
    temporary = None
    try:
        with held():
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


def cache_folder() -> Path:
    """Where this package keeps what it can make again: NERF_LIGHTNING_CACHE, or `nerf_lightning` in the user's cache."""
    if own := os.environ.get("NERF_LIGHTNING_CACHE"):
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nerf_lightning"
