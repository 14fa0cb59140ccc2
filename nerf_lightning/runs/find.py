"""Which run a path means: itself, or the newest below a folder."""

from pathlib import Path

from nerf_lightning.errors import InputError

OUTPUTS = Path("outputs")
"""Where training puts runs."""


def find_run(path: Path | None) -> Path:
    """Finds the run that a path means.

    Args:
        path: a run's folder or compact file, or a folder with runs below it, for the newest; None: the newest of all.

    Raises:
        InputError: where there is none.
    """
    root = OUTPUTS if path is None else path.expanduser()
    if root.is_file() or (root / "config.yaml").is_file():
        return root
    runs = [file.parent for file in root.rglob("config.yaml")] if root.is_dir() else []
    if not runs:
        raise InputError(root, "", "no run", "a folder that training has made", "train one, or give its path")
    return max(runs, key=lambda run: (run / "config.yaml").stat().st_mtime)
