"""Pages that are served until Ctrl-C. Heavy imports wait until the port is found."""

import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from nerf_lightning.errors import InputError
from nerf_lightning.view.serve import announcement, find_port, require_viser

if TYPE_CHECKING:
    from nerf_lightning.dataset import Scene
    from nerf_lightning.runs.open import SceneRun


def view_scene(
    scene: str, resize: int | None, holdout: int, photo_side: int, rays: int, samples: int, host: str, port: int
) -> None:
    """Serves a page about a scene until Ctrl-C.

    Args:
        scene, resize, holdout: see `nerf_lightning.dataset.open_scene`.
        photo_side, rays, samples: see `nerf_lightning.view.scene_page.ScenePage`.
        host: address of this machine to listen on.
        port: the next free one is taken where it is taken; 0 for any.

    Raises:
        InputError: no such scene, a damaged one, no such address, or Viser is not installed.
    """
    require_viser()
    address, free = find_port(host, port)

    from nerf_lightning.dataset import open_scene
    from nerf_lightning.view.scene_page import ScenePage

    with suppress(KeyboardInterrupt):
        page = ScenePage(open_scene(scene, resize=resize, holdout=holdout), host, free, photo_side, rays, samples)
        try:
            print(announcement(page.name, host, address, port, page.port), flush=True)
            threading.Event().wait()
        finally:
            page.stop()


def view_run(run: str, photo_side: int, side: int, device: str, host: str, port: int) -> None:
    """Serves a page about a trained run until Ctrl-C.

    Args:
        run: its folder, or its compact file.
        photo_side: longest side of the photos on the frusta, pixels.
        side: pixels along the longer side of the finest picture.
        device: that renders, see `the_device`.
        host, port: see `view_scene`.

    Raises:
        InputError: no such device, no such run, a damaged one, a picture's, no such address, or Viser is not installed.
    """
    from nerf_lightning.utils.device import the_device

    where = the_device(device)
    require_viser()
    address, free = find_port(host, port)

    from nerf_lightning.runs.open import open_scene_run
    from nerf_lightning.view.field_page import FieldPage

    source = Path(run).expanduser()
    found = open_scene_run(source, where)
    with suppress(KeyboardInterrupt):
        page = FieldPage(source.name, found.system, found.orbit, photos_of(found), host, free, photo_side, side)
        try:
            print(announcement(page.name, host, address, port, page.port), flush=True)
            page.run()
        finally:
            page.stop()


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
