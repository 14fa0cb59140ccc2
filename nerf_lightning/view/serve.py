"""Where a page is served, who can see it, and whether it can be served at all. Imports nothing heavy."""

import errno
import ipaddress
import socket

from nerf_lightning.errors import InputError
from nerf_lightning.utils.libraries import require

NEIGHBOURS = 50
"""How many ports are tried."""


def require_viser() -> None:
    """Raises InputError where Viser, an optional extra, is not installed."""
    require("view", "viser", purpose="the viewer's optional extra")


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
