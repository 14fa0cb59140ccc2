"""nerf_lightning view."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from nerf_lightning.cli.command import Device, command
from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import OUTPUT_ROOT, find_run, is_run
from nerf_lightning.utils.option_checks import Count, Ge, Le, Port
from nerf_lightning.utils.signals import SignalInterrupt

if TYPE_CHECKING:
    from nerf_lightning.view.page import Page


RunOrScene = Annotated[
    Path | None, Parameter(help="A run, a folder of runs for its newest, or a scene; default: the latest run.")
]


@command
def view(
    path: RunOrScene = None,
    /,
    *,
    resize: Count | Literal["auto"] | None = "auto",
    holdout: Annotated[int, Ge(2)] = 8,
    side: Annotated[int, Ge(64), Le(2048)] = 800,
    device: Device = "auto",
    host: str = "127.0.0.1",
    port: Port = 8080,
) -> None:
    """Show a trained run, or a scene's photos and cameras, in the browser, until Ctrl-C.

    Nothing is loaded from the internet. Images of a run are coarse at first, then get finer. To watch a training, give it
    callbacks=live.

    Args:
        resize: Of a scene: longest side of its photos in pixels; auto, as for a training of 90 s, or null for their size.
        holdout: Of a scene: every N-th photo is held out, unless the files say which.
        side: Of a run: pixels along the longer side of the finest image.
        host: This machine alone; 0.0.0.0 shares the page with the network.
        port: The next free one where it is taken; 0 for any.

    Raises:
        InputError: for no such run, scene, device or address, and where Viser is not installed.
    """
    from nerf_lightning.view.serve import announce, require_viser, resolve_host

    require_viser()
    resolve_host(host)
    if path is not None and not has_run(path):
        from nerf_lightning.dataset import PhotoLoadOptions, open_scene
        from nerf_lightning.view.scene_page import ScenePage

        page: Page = ScenePage(open_scene(str(path), options=PhotoLoadOptions(resize, holdout)), host, port)
    else:
        page = _open_run(find_run(path), device, side, host, port)
    try:
        print(f"{announce(page.name, host, port, page.port)}; Ctrl-C ends it", flush=True)
        page.run()
    except (SignalInterrupt, KeyboardInterrupt):
        pass
    finally:
        page.stop()


def has_run(path: Path) -> bool:
    """Whether a path is a run or a folder of runs; all else may be a scene."""
    import zipfile

    path = path.expanduser()
    if is_run(path) or path.absolute() == OUTPUT_ROOT.absolute():
        return True
    if not path.is_file():
        scene = any(path.glob("transforms*.json")) or any((path / name).exists() for name in ("images", "sparse"))
        return not scene and any(is_run(file.parent) for file in path.rglob("config.yaml"))
    try:
        with zipfile.ZipFile(path) as file:
            return "header.npy" in file.namelist()
    except (OSError, zipfile.BadZipFile):  # whatever reads it says what is wrong
        return False


def _open_run(source: Path, device: str, side: int, host: str, port: int) -> "Page":
    from nerf_lightning.runs.open import open_scene_run
    from nerf_lightning.runs.reload import reload_data
    from nerf_lightning.utils.device import resolve_device
    from nerf_lightning.view.field_page import FieldPage

    found = open_scene_run(source, resolve_device(device))
    scene = None
    try:
        scene = reload_data(found.cfg, found.scene).scene
    except InputError as error:
        print(f"without photos: {error}", flush=True)
    return FieldPage(source.resolve().name, found.system, found.orbit, scene, host, port, side)
