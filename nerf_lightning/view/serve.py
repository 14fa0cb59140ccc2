"""Where a page is served, who can see it, and whether it can be served at all. Imports nothing heavy."""

import socket

from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require_extra


def require_viser() -> None:
    """Raises InputError where Viser, an optional extra, is not installed."""
    require_extra("view", "viser", purpose="the viewer's optional extra")


def resolve_host(host: str) -> str:
    """The numeric address that `host` stands for.

    Raises:
        InputError: where that is no address of this machine.
    """
    try:
        if not host:  # would mean every address
            raise OSError("nothing")
        with socket.create_server((host, 0)) as server:
            return server.getsockname()[0]
    except OSError as error:
        hint = "127.0.0.1 for this machine alone, 0.0.0.0 to share the page with the network"
        found = f"{host!r} ({error.strerror or error})"
        raise InputError("view", "host", found, "an address of this machine", hint) from error


def announce(name: str, host: str, wanted: int, port: int) -> str:
    """The line that says where the page is and who can see it.

    Args:
        name: the page's.
        host: where it is served.
        wanted, port: the port that was asked for, 0 for any, and the one that it has.
    """
    seen = "127.0.0.1" if host == "0.0.0.0" else host
    taken = f" (port {wanted} is taken)" if port != wanted != 0 else ""
    shared = not resolve_host(host).startswith("127.")
    network = f"; shared with the network (--host {host}): all who reach this machine can see it" if shared else ""
    return f"{name}: http://{seen}:{port}{taken}{network}"
