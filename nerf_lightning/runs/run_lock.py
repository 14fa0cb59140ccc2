"""Who a run's folder belongs to: one process at a time, and to one run until somebody asks to replace it."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path

from filelock import FileLock, Timeout
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import RUN_MARKER
from nerf_lightning.utils.files import remove_empty_folders, remove_path

LOCK_FILE = ".lock"
"""In a folder that is or was written."""
RUN_OUTPUTS = ("config.yaml", "results.json", "checkpoints")
"""Any of these says that a folder holds a run."""


class RunFolderInUse(InputError):
    """A folder belongs to another run."""


def is_rank_zero() -> bool:
    """Whether this process is the first, or the only one, of those that share a run: the others write nothing."""
    return getattr(rank_zero_only, "rank", 0) == 0


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Locks a folder, which is made if it is missing, and removed again if nothing was written.

    Raises:
        Taken: while another process writes into it.
        InputError: where it holds files of others and no run.
    """
    if not is_rank_zero():
        yield
        return
    folder.mkdir(parents=True, exist_ok=True)
    if not (is_empty(folder) or has_run_outputs(folder) or (folder / RUN_MARKER).exists()):
        raise InputError(folder, "", "holds other files", hint="give a new or empty folder, or that of an earlier run")
    lock = FileLock(folder / LOCK_FILE, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        hint = "wait for its end, or give another folder"
        raise RunFolderInUse(folder, "", "a run is in progress in it", hint=hint) from error
    if is_empty(folder):
        (folder / RUN_MARKER).touch()
    try:
        yield
    finally:
        lock.release()
        if is_empty(folder):
            for name in (LOCK_FILE, RUN_MARKER):
                remove_path(folder / name)
            remove_empty_folders(folder)


@contextmanager
def lock_new_run_folder(folder: Path, overwrite: bool, allow_suffix: bool = False) -> Iterator[Path]:
    """Locks a folder for a run that starts anew; yields it.

    Args:
        folder: as asked for.
        overwrite: whether it may hold a run, which `delete_run_outputs` then removes.
        renamed: whether `folder-2`, `folder-3`, ... will do as well, where another run has it.

    Raises:
        Taken: where another run has it, in progress or not.
        InputError: as `lock_folder`.
    """
    for number in count(1):
        place = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        with ExitStack() as stack:
            try:
                stack.enter_context(lock_folder(place))
                if is_rank_zero() and has_run_outputs(place) and (allow_suffix or not overwrite):
                    raise make_run_exists_error(place)
            except RunFolderInUse:
                if allow_suffix:
                    continue
                raise
            yield place
            return


def make_run_exists_error(folder: Path) -> RunFolderInUse:
    """The error for a folder that holds a run."""
    hint = f"resume={folder} continues it, overwrite=true replaces it"
    return RunFolderInUse(folder, "", "holds a run already", hint=hint)


def has_run_outputs(folder: Path) -> bool:
    return any((folder / name).exists() for name in RUN_OUTPUTS)


def is_empty(folder: Path) -> bool:
    """Whether there is nothing but a lock and a marker."""
    return all(file.name in (LOCK_FILE, RUN_MARKER) for file in folder.iterdir())


def delete_run_outputs(folder: Path) -> None:
    """Removes an earlier run, so that none of its files is mistaken for a later one's: all files of a marked folder, elsewhere
    only those that say that there is a run."""
    if not has_run_outputs(folder):
        return
    marked = (folder / RUN_MARKER).exists()
    for path in list(folder.iterdir()):
        if path.name not in (LOCK_FILE, RUN_MARKER) and (marked or path.name in RUN_OUTPUTS):
            remove_path(path)
