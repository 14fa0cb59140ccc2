"""The figure of a sweep's runs, from their folder."""

from pathlib import Path

from nerf_lightning.gallery.figure import write_contact_figure
from nerf_lightning.runs.index import find_runs


def gallery(runs: str, output: str | None) -> None:
    """Draws the runs below a folder, and says where the figure is.

    Args:
        runs: the folder.
        output: the PNG; None means gallery.png in the folder.

    Raises:
        InputError: no such folder, or no run in it.
    """
    root = Path(runs).expanduser()
    path = write_contact_figure(root, find_runs(root), None if output is None else Path(output).expanduser())
    print(f"figure: {path}")
