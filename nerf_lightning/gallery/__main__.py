"""python -m nerf_lightning.gallery: the figure of any sweep, from its folder alone. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import output_path, user_path
from nerf_lightning.utils.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration, draws the runs below a folder, and says where the figure is."""
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if not OmegaConf.is_missing(cfg, key)}
    check_options("", gallery, given)
    gallery(**given)


def gallery(runs: str, output: str | None) -> None:
    """Draws the runs below the folder `runs` into the PNG `output`, or gallery.png in that folder.

    Raises:
        InputError: no such folder, no run in it, or another name than a PNG's.
    """
    from nerf_lightning.gallery.figure import write_contact_figure
    from nerf_lightning.runs.index import find_runs

    root, file = user_path(runs), None if output is None else output_path(output)
    if file is not None and file.suffix.lower() != ".png":
        raise InputError("config", "output", repr(output), "a file that ends in .png")
    print(f"figure: {write_contact_figure(root, find_runs(root), file)}")


if __name__ == "__main__":
    cli.run("gallery", task)
