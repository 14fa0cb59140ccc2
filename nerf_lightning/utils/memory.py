"""What memory is left, and the refusal of what would not fit into it: before it is asked for, as a process that asks for too
much is killed without a word."""

import math
import re
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import psutil
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import CPU

CONTAINERS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Where Linux tells a container's limit and what it uses of it, in its second and first version of control groups."""


def free_memory(device: torch.device = CPU) -> float:
    """Bytes that this process can still have: of an accelerator, or of the machine, its container, and its own limit of
    addresses."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    if device.type == "mps":
        return float(torch.mps.recommended_max_memory() - torch.mps.driver_allocated_memory())
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


def check_memory(
    where: object, key: str, what: str, needed: float, todo: str = "give less", device: torch.device = CPU
) -> None:
    """Refuses what certainly needs more memory than is free.

    Args:
        where, key, todo: see `InputError`.
        what: the things, in words.
        needed: bytes that they take at least.
        device: whose memory.

    Raises:
        InputError: where more is needed than is free.
    """
    free = free_memory(device)
    if not needed <= free:
        found, there = (f"{part / 2**30:,.1f} GiB" for part in (needed, free))
        raise InputError(where, key, f"{what} that take at least {found}", f"at most the {there} that are free", todo)


def out_of_memory(error: BaseException) -> InputError | None:
    """The error to tell where memory has run out; None for one of another kind.

    Accelerators say so, and so does a CPU where a limit is set; otherwise the system ends the process.
    """
    if not isinstance(error, MemoryError | torch.OutOfMemoryError) and "allocate memory" not in str(error):
        return None
    asked = re.search(r"allocate ([\d.]+ \w+)", str(error))
    less = "dataset.rays, dataset.samples, dataset.pixels, limits.batch or limits.chunk"
    found = f"no room for {asked[1] if asked else 'what was asked'}"
    return InputError("memory", "", found, "what fits into it", f"give less of {less}, or a smaller model")


class Frugal(TorchDispatchMode):
    """While it is entered, tensors that are made from nothing must fit into the free memory, all together and twice: training
    keeps a copy.

    Args:
        where, key: what makes them, for the message.

    Raises:
        InputError: before a tensor is made that does not fit any more.
    """

    def __init__(self, where: str, key: str):
        super().__init__()
        self.place = where, key
        self.free = free_memory()
        self.taken = 0

    def __torch_dispatch__(
        self, func: Any, types: Iterable[type], args: tuple = (), kwargs: Mapping[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if "device" in kwargs:
            self.taken += _numbers(func, args) * (kwargs.get("dtype") or torch.get_default_dtype()).itemsize
            if 2 * self.taken > self.free:
                check_memory(*self.place, "numbers, with the copy that training keeps,", 2 * self.taken)
        return func(*args, **kwargs)


def _numbers(func: Any, args: tuple) -> int:
    """How many a new tensor holds: a whole number of Python, which does not overflow as a tensor's size would."""
    if func.overloadpacket is torch.ops.aten.arange:
        start, end = (0, args[0]) if len(args) == 1 else args[:2]
        return math.ceil(abs(end - start))
    return next((math.prod(part) for part in args if isinstance(part, list | tuple)), 0)
