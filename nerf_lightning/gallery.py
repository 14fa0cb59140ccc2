"""python -m nerf_lightning.gallery: the figure of any sweep, from its folder alone. Heavy imports wait until there is work."""

from pathlib import Path
from typing import TYPE_CHECKING

from nerf_lightning import cli
from nerf_lightning.options import check_options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from omegaconf import DictConfig

    from nerf_lightning.runs import Run

FIGURE = "gallery.png"


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and draws."""
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if not OmegaConf.is_missing(cfg, key)}
    check_options("", gallery, given)
    gallery(**given)


def gallery(runs: str, output: str | None) -> None:
    """Draws the runs below a folder, and says where the figure is.

    Args:
        runs: the folder.
        output: the PNG; None means gallery.png in the folder.

    Raises:
        InputError: no such folder, or no run in it.
    """
    from nerf_lightning.runs import find_runs

    root = Path(runs).expanduser()
    print(f"figure: {draw(root, find_runs(root), None if output is None else Path(output).expanduser())}")


def draw(root: Path, runs: "Sequence[Run]", output: Path | None = None) -> Path:
    """Draws the runs found below a folder; returns the path of the PNG."""
    from nerf_lightning.callbacks.panels import write_png
    from nerf_lightning.contact_figure import contact_figure
    from nerf_lightning.ink import pixels_of

    scenes = sorted({str((run.results.get("scene") or {}).get("name", "")) for run in runs} - {""})
    path = root / FIGURE if output is None else output
    title = ": ".join(["/".join(root.resolve().parts[-2:]), *filter(None, [", ".join(scenes)])])
    write_png(path, pixels_of(contact_figure(runs, title)))
    return path


def main() -> None:
    """The command line."""
    cli.run("gallery", task)


if __name__ == "__main__":
    main()
