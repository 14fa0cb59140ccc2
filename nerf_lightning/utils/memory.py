"""What memory is left, and the refusal of what would not fit into it: before it is asked for, as a process that asks for too
much is killed without a word."""

import sys
from pathlib import Path

import psutil

from nerf_lightning.errors import InputError

CONTAINERS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Where Linux tells a container's limit and what it uses of it, in its second and first version of control groups."""


def free_memory() -> float:
    """Bytes that this process can still have: of the machine, of its container, and of its own limit of addresses."""
    left = [float(psutil.virtual_memory().available)]
    for most, used in CONTAINERS:
        try:
            limit, current = (Path(file).read_text(encoding="utf-8").strip() for file in (most, used))
        except OSError:  # no container of this kind
            continue
        if limit != "max":
            left.append(float(limit) - float(current) + _reclaimable(Path(most).parent / "memory.stat"))
    if sys.platform != "win32":
        import resource

        limit_of_addresses = resource.getrlimit(resource.RLIMIT_AS)[0]
        if limit_of_addresses != resource.RLIM_INFINITY:
            left.append(limit_of_addresses - float(psutil.Process().memory_info().vms))
    return max(min(left), 0.0)


def _reclaimable(statistics: Path) -> float:
    """Bytes of a container's files in memory, which make room when they must."""
    try:
        lines = statistics.read_text(encoding="utf-8").splitlines()
    except OSError:
        return 0.0
    return sum(float(line.split()[1]) for line in lines if line.startswith("inactive_file "))


def check_memory(where: object, key: str, what: str, needed: float, todo: str = "") -> None:
    """Refuses what would not fit into memory.

    Args:
        where, key, todo: see `InputError`.
        what: needs the memory, in words.
        needed: bytes.

    Raises:
        InputError: where more is needed than is free.
    """
    free = free_memory()
    if not needed <= free:
        found = f"{what} for which {needed / 1e9:,.1f} GB of memory is needed"
        raise InputError(where, key, found, f"at most the {free / 1e9:,.1f} GB that are left", todo)
