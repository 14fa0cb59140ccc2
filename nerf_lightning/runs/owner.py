"""Who a run's folder belongs to: one process at a time, and to one run until somebody asks to replace it."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path

from filelock import FileLock, Timeout
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import MARKER
from nerf_lightning.utils.files import remove, remove_empty

LOCK = ".lock"
"""In a folder that is or was written."""
RUN = ("config.yaml", "results.json", "checkpoints")
"""Any of these says that a folder holds a run."""


class Taken(InputError):
    """A folder belongs to another run."""


def leads() -> bool:
    """Whether this process is the first, or the only one, of those that share a run: the others write nothing."""
    return getattr(rank_zero_only, "rank", 0) == 0


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Locks a folder, which is made if it is missing, and removed again if nothing was written.

    Raises:
        Taken: while another process writes into it.
        InputError: where it holds files of others and no run.
    """
    if not leads():
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    if not (is_empty(folder) or holds_run(folder) or (folder / MARKER).exists()):
        raise InputError(folder, "", "other files in it", "a new or empty folder, or that of an earlier run")
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        todo = "wait for its end, or give another folder"
        raise Taken(folder, "", "a run that is in progress", "a folder that no other process uses", todo) from error
    if is_empty(folder):
        (folder / MARKER).touch()
    try:
        yield
    finally:
        lock.release()
        if is_empty(folder):
            for name in (LOCK, MARKER):
                remove(folder / name)
            remove_empty(folder)


@contextmanager
def own_folder(folder: Path, overwrite: bool, renamed: bool = False) -> Iterator[Path]:
    """Locks a folder for a run that starts anew; yields it.

    Args:
        folder: as asked for.
        overwrite: whether it may hold a run, which `clear` then removes.
        renamed: whether `folder-2`, `folder-3`, ... will do as well, where another run has it.

    Raises:
        Taken: where another run has it, in progress or not.
        InputError: as `owned`.
    """
    for number in count(1):
        place = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        with ExitStack() as stack:
            try:
                stack.enter_context(owned(place))
                if leads() and holds_run(place) and (renamed or not overwrite):
                    raise already(place)
            except Taken:
                if renamed:
                    continue
                raise
            yield place
            return


def already(folder: Path) -> Taken:
    """The error for a folder that holds a run."""
    todo = f"resume={folder} continues it, overwrite=true replaces it"
    return Taken(folder, "", "a run in it already", "a folder of its own for each run", todo)


def holds_run(folder: Path) -> bool:
    return any((folder / name).exists() for name in RUN)


def is_empty(folder: Path) -> bool:
    """Whether there is nothing but a lock and a marker."""
    return all(file.name in (LOCK, MARKER) for file in folder.iterdir())


def clear(folder: Path) -> None:
    """Removes an earlier run, so that none of its files is mistaken for a later one's: all files of a marked folder, elsewhere
    only those that say that there is a run."""
    if not holds_run(folder):
        return
    marked = (folder / MARKER).exists()
    for path in list(folder.iterdir()):
        if path.name not in (LOCK, MARKER) and (marked or path.name in RUN):
            remove(path)
