"""Finds a run by its folder, its compact file, a folder of runs, or as the newest of all."""

import logging
import os
from pathlib import Path

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import expand_user_path

OUTPUT_ROOT = Path("outputs")
"""Where training puts runs."""
RUN_MARKER = ".nerf_lightning"
"""In a folder that was new or empty when a run was put there, so that all in it is this package's own."""
LAST_CHECKPOINT = Path("checkpoints", "last.ckpt")
"""In a run's folder."""
LATEST_LINK = "latest"
"""The link beside the runs of one name to the one that began last."""
log = logging.getLogger(__name__)


def find_run(path: str | os.PathLike[str] | None = None) -> Path:
    """The folder or compact file of a run.

    Args:
        path: of either, or of a folder of runs, which stands for its newest run; None for the newest below `outputs/`.

    Raises:
        InputError: where there is none.
    """
    root = OUTPUT_ROOT if path is None else expand_user_path(path)
    if root.name == LATEST_LINK and not root.exists():  # where links are not possible
        root = root.parent
    if root.is_file() or is_run(root):
        return root
    runs = [file.parent for file in root.rglob("config.yaml") if is_run(file.parent)]
    if not runs:
        found = "a folder without a run" if root.is_dir() else "no such file or folder"
        raise InputError(root, "", found, hint="give a folder with config.yaml and checkpoints/, or a .npz file")
    return max(runs, key=lambda run: (run / LAST_CHECKPOINT).stat().st_mtime)


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run that can be opened."""
    return (folder / "config.yaml").is_file() and (folder / LAST_CHECKPOINT).is_file()


def link_latest(folder: Path) -> None:
    """Points `outputs/NAME/latest` to the run folder `outputs/NAME/TIME`; does nothing for other folders."""
    folder = folder.absolute()
    if folder.parent.parent.name != OUTPUT_ROOT.name or not (folder / RUN_MARKER).exists():
        return
    link = folder.with_name(LATEST_LINK)
    temporary = link.with_name(f".{LATEST_LINK}-{os.getpid()}")
    try:
        temporary.symlink_to(folder.name, target_is_directory=True)
        os.replace(temporary, link)
    except OSError as error:  # Windows without the right to; or a folder of this name
        temporary.unlink(missing_ok=True)
        log.warning("%s: no link to the newest run (%s)", link, error.strerror)
