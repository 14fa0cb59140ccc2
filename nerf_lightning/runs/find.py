"""Run lookup: by folder, compact file, folder of runs, or the newest."""

import logging
import os
from pathlib import Path

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import expand_user_path

OUTPUT_ROOT = Path("outputs")
"""Default root of run folders."""
RUN_MARKER = ".nerf_lightning"
"""Marks a folder that was new or empty when a run started, so that all its files belong to the run."""
LAST_CHECKPOINT = Path("checkpoints", "last.ckpt")
"""Path within a run's folder."""
LATEST_LINK = "latest"
"""Symbolic link to the newest run of a name."""
log = logging.getLogger(__name__)


def find_run(path: str | os.PathLike[str] | None = None) -> Path:
    """The folder or compact file of a run.

    Args:
        path: a run folder, a compact file, or a folder of runs, for its newest run; None: the newest below `outputs/`.

    Raises:
        InputError: there is no run.
    """
    root = OUTPUT_ROOT if path is None else expand_user_path(path)
    if root.name == LATEST_LINK and not root.exists():  # links may be unsupported
        root = root.parent
    if root.is_file() or is_run(root):
        return root
    runs = [file.parent for file in root.rglob("config.yaml") if is_run(file.parent)]
    if not runs:
        problem = "a folder without a run" if root.is_dir() else "no such file or folder"
        raise InputError(root, "", problem, hint="give a folder with config.yaml and checkpoints/, or a .npz file")
    return max(runs, key=lambda run: (run / LAST_CHECKPOINT).stat().st_mtime)


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run with a checkpoint."""
    return (folder / "config.yaml").is_file() and (folder / LAST_CHECKPOINT).is_file()


def link_latest(folder: Path) -> None:
    """Links `outputs/NAME/latest` to the run folder `outputs/NAME/TIME`; ignores other folders."""
    folder = folder.absolute()
    if folder.parent.parent.name != OUTPUT_ROOT.name or not (folder / RUN_MARKER).exists():
        return
    link = folder.with_name(LATEST_LINK)
    temporary = link.with_name(f".{LATEST_LINK}-{os.getpid()}")
    try:
        temporary.symlink_to(folder.name, target_is_directory=True)
        os.replace(temporary, link)
    except OSError as error:  # no permission (Windows), or an existing folder
        temporary.unlink(missing_ok=True)
        log.warning("%s: no link to the newest run (%s)", link, error.strerror)
