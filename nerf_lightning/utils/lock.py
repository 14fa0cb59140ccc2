"""A lock that a process holds: the system lets go of it when the process ends, however it ends, so that none is ever stale."""

import errno
import logging
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

log = logging.getLogger(__name__)

FAR = 1 << 30
"""The byte that is locked on Windows, where what is locked cannot be read: beyond what the file holds."""
HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
"""What systems answer where another holds the lock."""
LETTERS = 200
"""Most that is read of who holds a lock."""
ATTEMPTS = 100
"""How often to try where the file, or its empty folder, is removed by others while it is opened: each time by another one."""


class Held(Exception):
    """Somebody else holds the lock; the message says who."""


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Holds the file `path`, made with its folders where it is missing, and removes it at the end.

    Raises:
        Held: another process has it, or another part of this one.
        OSError: where it cannot be made.
    """
    handle = _opened(path)
    try:
        os.ftruncate(handle, 0)
        os.write(handle, f"process {os.getpid()} on {platform.node()}"[:LETTERS].encode())
        yield
    finally:
        if sys.platform == "win32":
            os.close(handle)
            with suppress(OSError):  # an open file cannot be removed: another has it by now
                path.unlink()
        else:
            path.unlink(missing_ok=True)  # while it is held: who has opened it meanwhile sees that it is gone
            os.close(handle)


def _opened(path: Path) -> int:
    for left in reversed(range(ATTEMPTS)):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        except FileNotFoundError:  # the folder was empty, and was removed in between
            if not left:
                raise
            continue
        try:
            _lock(handle)
            if os.path.samestat(os.fstat(handle), path.stat()):
                return handle
        except FileNotFoundError:
            pass  # removed by the one who held it
        except OSError as error:
            if error.errno in HELD:
                who = os.read(handle, LETTERS).decode(errors="replace")
                os.close(handle)
                raise Held(who or "another process") from error
            log.warning("%s: cannot be locked (%s): two runs at once would not notice each other", path, error.strerror)
            return handle
        os.close(handle)
    raise Held("another process")


def _lock(handle: int) -> None:
    if sys.platform == "win32":
        os.lseek(handle, FAR, os.SEEK_SET)
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        finally:
            os.lseek(handle, 0, os.SEEK_SET)
    else:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
