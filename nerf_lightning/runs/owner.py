"""Who a run's folder belongs to: one process at a time, and to one run until somebody asks to replace it."""

import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import count
from pathlib import Path

from lightning.pytorch.utilities.rank_zero import rank_zero_only
from omegaconf import DictConfig

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import remove_empty
from nerf_lightning.utils.lock import Held, locked

LOCK = ".lock"
"""In a folder that is being written: held by the process that does."""
RUN = ("config.yaml", "results.json", "checkpoints")
"""Any of these says that a folder holds a run."""
MADE = (
    *RUN, "scene.json", "error.txt", "events.out.tfevents.*", "snapshots", "final.png", "truth.png", "orbit.gif",
    "training.gif", "error.png", "spectrum.png", "curve.png", "csv", "wandb", "baselines.json", "enlarged.*", "enlarged_*",
    "compact.npz", "field.html", "mesh.ply", "mesh.obj", "mesh.glb", "mesh.stl", "points.ply", "voxels.npz", "posed",
    "render_*", "evaluation",
)  # fmt: skip
"""What runs leave, and what the verbs make from them, where no other names are given."""


class Taken(InputError):
    """A folder belongs to another run."""


def leads() -> bool:
    """Whether this process is the first, or the only one, of those that share a run: the others write nothing."""
    return getattr(rank_zero_only, "rank", 0) == 0


@contextmanager
def owned(folder: Path) -> Iterator[None]:
    """Holds a folder, which is made if it is missing, and removed again if nothing was written.

    Raises:
        Taken: while another process holds it.
        InputError: where it cannot be written.
    """
    if not leads():
        yield
        return
    with ExitStack() as stack:
        if not folder.exists():
            stack.callback(remove_empty, folder)
        try:
            stack.enter_context(locked(folder / LOCK))
        except Held as error:
            found, todo = f"a run that is still going on ({error})", "wait for its end, or give another folder"
            raise Taken(folder, "", found, "a folder that no other process writes into", todo) from error
        except OSError as error:
            raise InputError(folder, "", error.strerror or str(error), "a folder that can be written") from error
        yield


@contextmanager
def own_folder(folder: Path, overwrite: bool, renamed: bool = False) -> Iterator[Path]:
    """Holds a folder for a run that starts anew; yields it.

    Args:
        folder: as asked for.
        overwrite: whether it may hold a run, which `clear` then removes.
        renamed: whether `folder-2`, `folder-3`, ... will do as well, where another run has it.

    Raises:
        Taken: where another run has it, going on or not.
        InputError: where it cannot be written.
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
    """What to say of a folder that holds a run."""
    todo = f"resume={folder} goes on with it, overwrite=true replaces it"
    return Taken(folder, "", "a run in it already", "a folder of its own for each run", todo)


def may_overwrite(cfg: DictConfig) -> bool:
    """Whether the user asks to replace what is there.

    Raises:
        InputError: for anything but true and false.
    """
    if not isinstance(cfg.overwrite, bool):
        raise InputError("config", "overwrite", repr(cfg.overwrite), "true or false")
    return cfg.overwrite


def holds_run(folder: Path) -> bool:
    return any((folder / name).exists() for name in RUN)


def clear(folder: Path) -> None:
    """Removes an earlier run's files from a folder, so that none is mistaken for a later one's; all others stay."""
    if not holds_run(folder):
        return
    for path in [path for name in MADE for path in folder.glob(name)]:
        remove(path)


def remove(path: Path) -> None:
    """Removes a file, or a folder with all that is in it, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
