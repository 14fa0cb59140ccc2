"""Address and availability checks of viewer pages. Fast to import."""

import socket

from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require_extra


def require_viser() -> None:
    """Checks that Viser, an optional extra, is installed."""
    require_extra("view", "viser", purpose="the viewer's optional extra")


def resolve_host(host: str) -> str:
    """Resolves `host` to a numeric address.

    Raises:
        InputError: it is no address of this machine.
    """
    try:
        if not host:  # an empty host means all addresses
            raise OSError("nothing")
        with socket.create_server((host, 0)) as server:
            return server.getsockname()[0]
    except OSError as error:
        hint = "127.0.0.1 for this machine alone, 0.0.0.0 to share the page with the network"
        problem = f"{host!r} ({error.strerror or error})"
        raise InputError("view", "host", problem, "an address of this machine", hint) from error


def announce(name: str, host: str, requested_port: int, port: int) -> str:
    """The message with a page's URL and its visibility.

    Args:
        name: the page's title.
        host: address it listens on.
        requested_port, port: 0 requests any.
    """
    address = "127.0.0.1" if host == "0.0.0.0" else host
    taken = f" (port {requested_port} is taken)" if port != requested_port != 0 else ""
    shared = not resolve_host(host).startswith("127.")
    network = f"; shared with the network (--host {host}): all who reach this machine can see it" if shared else ""
    return f"{name}: http://{address}:{port}{taken}{network}"
