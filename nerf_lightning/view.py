"""python -m nerf_lightning.view: a scene in the browser, until Ctrl-C. Heavy imports wait until there is work."""

import errno
import ipaddress
import socket
import threading
from contextlib import suppress
from typing import TYPE_CHECKING, Annotated

from nerf_lightning import cli
from nerf_lightning.errors import InputError
from nerf_lightning.options import AtLeast, Count, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig

NEIGHBOURS = 50
"""How many ports are tried."""


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and shows what it names."""
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if not OmegaConf.is_missing(cfg, key)}
    check_options("", view_scene, given)
    view_scene(**given)


def view_scene(
    scene: str,
    resize: Count | None,
    holdout: Annotated[int, AtLeast(2)],
    photo_side: Count,
    rays: Count,
    samples: Count,
    host: str,
    port: Annotated[int, AtLeast(0)],
) -> None:
    """Serves a page about a scene until Ctrl-C.

    Args:
        scene, resize, holdout: see `nerf_lightning.dataset.open_scene`.
        photo_side, rays, samples: see `nerf_lightning.scene_page.ScenePage`.
        host: address of this machine to listen on.
        port: the next free one is taken where it is taken; 0 for any.

    Raises:
        InputError: no such scene, a damaged one, no such address, or Viser is not installed.
    """
    require_viser()
    address, free = find_port(host, port)

    from nerf_lightning.dataset import open_scene
    from nerf_lightning.scene_page import ScenePage

    with suppress(KeyboardInterrupt):
        page = ScenePage(open_scene(scene, resize=resize, holdout=holdout), host, free, photo_side, rays, samples)
        try:
            print(announcement(page.scene.name, host, address, port, page.port), flush=True)
            threading.Event().wait()
        finally:
            page.stop()


def require_viser() -> None:
    """Raises InputError where Viser, an optional extra, is not installed."""
    try:
        import viser  # noqa: F401
    except ModuleNotFoundError as error:
        if error.name != "viser":
            raise
        todo = "pip install 'nerf_lightning[view]'"
        raise InputError("viser", "", "no such package", "the viewer's optional extra", todo) from error


def find_port(host: str, port: int) -> tuple[str, int]:
    """The numeric address that `host` stands for, and the first free port from `port` on.

    Raises:
        InputError: `host` is no address of this machine, or no port is free there.
    """
    expected = "an address of this machine"
    todo = "127.0.0.1 for this machine alone, 0.0.0.0 to share the page with the network"
    if not host:  # would quietly mean every address
        raise InputError("config", "host", "nothing", expected, todo)
    for candidate in range(port, min(port + NEIGHBOURS, 65536)):
        try:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            with socket.create_server((host, candidate), family=family) as server:
                return server.getsockname()[:2]
        except OSError as error:
            if error.errno == errno.EACCES:
                raise InputError("config", "port", f"{port}, which is reserved", "1024 or above") from error
            if error.errno != errno.EADDRINUSE:
                raise InputError("config", "host", f"{host!r} ({error.strerror})", expected, todo) from error
    raise InputError(
        "config", "port", f"{port}, with none free from there on", "a free port", "give another, or 0 for any"
    )


def announcement(name: str, host: str, address: str, wanted: int, port: int) -> str:
    """The line that says where the page is, who can see it and how to end it."""
    shared = not ipaddress.ip_address(address).is_loopback
    seen = "127.0.0.1" if address == "0.0.0.0" else "[::1]" if address == "::" else f"[{host}]" if ":" in host else host
    taken = f" (port {wanted} is taken)" if port != wanted != 0 else ""
    network = f"; shared with the network (host={host}): all who reach this machine can see it" if shared else ""
    return f"{name}: http://{seen}:{port}{taken}{network}; Ctrl-C ends it"


def main() -> None:
    """The command line."""
    cli.run("view", task)


if __name__ == "__main__":
    main()
