"""Locks on run folders: one process at a time, one run unless overwriting is requested."""

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
RUN_OUTPUTS = ("config.yaml", "results.json", "checkpoints")
"""Files that mark a folder as a run."""


class RunFolderInUse(InputError):
    """The folder belongs to another run."""


def is_rank_zero() -> bool:
    """Whether this process is the one that writes, of those that share a run."""
    return getattr(rank_zero_only, "rank", 0) == 0


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Creates and locks a folder; removes it again if nothing was written.

    Raises:
        RunFolderInUse: another process writes into it.
        InputError: the folder holds other files and no run.
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
        hint = "wait until it ends, or give another folder"
        raise RunFolderInUse(folder, "", "another run is writing into it", hint=hint) from error
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
    """Locks a folder for a new run and yields it.

    Args:
        folder: requested folder.
        overwrite: allow an existing run, which `delete_run_outputs` then removes.
        allow_suffix: fall back to `folder-2`, `folder-3`, ... if the folder holds a run.

    Raises:
        RunFolderInUse: the folder holds another run, finished or not.
        InputError: as `lock_folder`.
    """
    for number in count(1):
        candidate = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        with ExitStack() as stack:
            try:
                stack.enter_context(lock_folder(candidate))
                if is_rank_zero() and has_run_outputs(candidate) and (allow_suffix or not overwrite):
                    raise make_run_exists_error(candidate)
            except RunFolderInUse:
                if allow_suffix:
                    continue
                raise
            yield candidate
            return


def make_run_exists_error(folder: Path) -> RunFolderInUse:
    hint = f"resume={folder} continues it, overwrite=true replaces it"
    return RunFolderInUse(folder, "", "holds a run already", hint=hint)


def has_run_outputs(folder: Path) -> bool:
    return any((folder / name).exists() for name in RUN_OUTPUTS)


def is_empty(folder: Path) -> bool:
    """Whether a folder holds nothing but a lock and a marker."""
    return all(file.name in (LOCK_FILE, RUN_MARKER) for file in folder.iterdir())


def delete_run_outputs(folder: Path) -> None:
    """Deletes an earlier run: all files of a marked folder, elsewhere only `RUN_OUTPUTS`."""
    if not has_run_outputs(folder):
        return
    marked = (folder / RUN_MARKER).exists()
    for path in list(folder.iterdir()):
        if path.name not in (LOCK_FILE, RUN_MARKER) and (marked or path.name in RUN_OUTPUTS):
            remove_path(path)
