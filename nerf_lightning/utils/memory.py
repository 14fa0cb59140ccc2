"""How much memory is free; and a line for what certainly needs more, before any of it is taken."""

import math
import sys
from collections.abc import Iterable, Mapping
from typing import Any

import psutil
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import CPU

if sys.platform != "win32":
    import resource


def free_memory(device: torch.device = CPU) -> int:
    """Bytes that this process may still take: of a CPU's memory those that are available, or that a limit of the process
    leaves."""
    if device.type == "cuda":
        return torch.cuda.mem_get_info(device)[0]
    if device.type == "mps":
        return torch.mps.recommended_max_memory() - torch.mps.driver_allocated_memory()
    free = psutil.virtual_memory().available
    if sys.platform == "win32":
        return free
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    return free if limit == resource.RLIM_INFINITY else min(free, limit - psutil.Process().memory_info().vms)


def require_room(
    where: object, key: str, what: str, size: float, todo: str = "give less", device: torch.device = CPU
) -> None:
    """Refuses what certainly needs more memory than is free.

    Args:
        where, key: what asks for it.
        what: the things, in words.
        size: bytes that they take at least.
        todo: what the user can do about it.
        device: whose memory.

    Raises:
        InputError: where there is less.
    """
    free = free_memory(device)
    if size > free:
        found, there = (f"{part / 2**30:,.1f} GiB" for part in (size, free))
        raise InputError(where, key, f"{what} that take at least {found}", f"at most the {there} that are free", todo)


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
                require_room(*self.place, "numbers, with the copy that training keeps,", 2 * self.taken)
        return func(*args, **kwargs)


def _numbers(func: Any, args: tuple) -> int:
    """How many a new tensor holds: a whole number of Python, which does not overflow as a tensor's size would."""
    if func.overloadpacket is torch.ops.aten.arange:
        start, end = (0, args[0]) if len(args) == 1 else args[:2]
        return math.ceil(abs(end - start))
    return next((math.prod(part) for part in args if isinstance(part, list | tuple)), 0)
