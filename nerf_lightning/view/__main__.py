"""python -m nerf_lightning.view: a trained run or a scene in the browser, until Ctrl-C.

Heavy imports wait until the configuration is checked and a port is found.
"""

from contextlib import suppress
from typing import TYPE_CHECKING, Annotated, Any

from nerf_lightning.config import cli
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import user_path
from nerf_lightning.utils.options import AtLeast, Count, Port, check_options
from nerf_lightning.utils.signals import Interrupted
from nerf_lightning.view.serve import announcement, find_port, require_viser

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from nerf_lightning.dataset import Scene
    from nerf_lightning.runs.open import SceneRun
    from nerf_lightning.view.page import Page

POINT = 24
"""Bytes of a sample that is shown: a position and a colour."""


def options(
    scene: str | None,
    run: str | None,
    resize: Count | str | None,
    holdout: Annotated[int, AtLeast(2)],
    photo_side: Count,
    rays: Count,
    samples: Count,
    side: Count,
    device: str,
    host: str,
    port: Port,
) -> None:
    """The keys of conf/view.yaml, for checking."""


def task(cfg: "DictConfig") -> None:
    """Serves a page about the scene or the run that the configuration names, until Ctrl-C.

    Raises:
        InputError: a wrong key, no such device, run or scene, or a damaged one, no such address, or Viser is not installed.
    """
    given = {str(key): cfg[key] for key in cfg}
    check_options("", options, given)
    if (given["scene"] is None) == (given["run"] is None):
        found = "nothing" if given["run"] is None else "both"
        raise InputError("config", "scene and run", found, "one of the two", "give scene=scene.npz or run=DIR")
    require_viser()
    address, port = find_port(given["host"], given["port"])
    with suppress(Interrupted):
        page = (page_of_scene if given["run"] is None else page_of_run)(given, port)
        try:
            print(announcement(page.name, given["host"], address, given["port"], page.port), flush=True)
            page.run()
        finally:
            page.stop()


def page_of_scene(given: dict[str, Any], port: int) -> "Page":
    """The page about a scene."""
    from nerf_lightning.dataset import Reading, open_scene
    from nerf_lightning.dataset.size import parse_resize
    from nerf_lightning.utils.memory import check_memory
    from nerf_lightning.view.scene_page import ScenePage

    points = given["rays"] * given["samples"]
    check_memory("config", "rays, samples", f"{points:,} samples to show", POINT * points)
    scene = open_scene(given["scene"], reading=Reading(parse_resize(given["resize"]), given["holdout"]))
    return ScenePage(scene, given["host"], port, given["photo_side"], given["rays"], given["samples"])


def page_of_run(given: dict[str, Any], port: int) -> "Page":
    """The page about a trained run, or its compact file."""
    from nerf_lightning.utils.device import the_device

    device = the_device(given["device"])

    from nerf_lightning.runs.open import open_scene_run
    from nerf_lightning.view.field_page import FieldPage

    source = user_path(given["run"])
    found = open_scene_run(source, device)
    photos = photos_of(found)
    return FieldPage(
        source.name, found.system, found.orbit, photos, given["host"], port, given["photo_side"], given["side"]
    )


def photos_of(found: "SceneRun") -> "Scene | None":
    """The photos a run was trained on; None, and a line that says so, where they are no longer there."""
    from nerf_lightning.dataset import Scene
    from nerf_lightning.runs.data import data_again

    try:
        scene = data_again(found.cfg, found.scene).scene
    except InputError as error:
        print(f"without photos: {error}", flush=True)
        return None
    assert isinstance(scene, Scene)  # of a scene's run
    return scene


def main() -> None:
    """The command line."""
    cli.run("view", task, texts=("scene", "run"))


if __name__ == "__main__":
    main()
