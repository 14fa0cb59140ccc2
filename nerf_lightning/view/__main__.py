"""python -m nerf_lightning.view: a trained run or a scene in the browser, until Ctrl-C. Imports nothing heavy until then."""

from typing import TYPE_CHECKING, Annotated

from nerf_lightning.config import cli
from nerf_lightning.errors import InputError
from nerf_lightning.utils.options import AtLeast, Count, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def options(
    scene: str | None,
    run: str | None,
    resize: Count | None,
    holdout: Annotated[int, AtLeast(2)],
    photo_side: Count,
    rays: Count,
    samples: Count,
    side: Count,
    device: str,
    host: str,
    port: Annotated[int, AtLeast(0)],
) -> None:
    """The keys of conf/view.yaml, for checking."""


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and shows what it names."""
    given = {str(key): cfg[key] for key in cfg}
    check_options("", options, given)
    if (given["scene"] is None) == (given["run"] is None):
        found = "nothing" if given["run"] is None else "both"
        raise InputError("config", "scene and run", found, "one of the two", "give scene=scene.npz or run=DIR")

    from nerf_lightning.view.verb import view_run, view_scene

    place = {"host": given["host"], "port": given["port"]}
    if given["run"] is not None:
        view_run(given["run"], given["photo_side"], given["side"], given["device"], **place)
    else:
        keys = ("scene", "resize", "holdout", "photo_side", "rays", "samples")
        view_scene(**{key: given[key] for key in keys}, **place)


def main() -> None:
    """The command line."""
    cli.run("view", task, texts=("scene", "run"))


if __name__ == "__main__":
    main()
