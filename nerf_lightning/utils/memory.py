"""Free memory, a refusal of what does not fit into it (the system would kill the process silently), and the C allocator."""

import ctypes
import re
import sys
from pathlib import Path

import psutil
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import CPU

CONTAINERS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
"""Limit and use of a Linux container's memory, in version 2 and 1 of control groups."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h of the GNU C library


def free_memory(device: torch.device = CPU) -> float:
    """Bytes that this process can still have: of an accelerator, or of the machine, its container and its own address space."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    if device.type == "mps":
        return float(torch.mps.recommended_max_memory() - torch.mps.driver_allocated_memory())
    free = [float(psutil.virtual_memory().available)]
    for limit_file, use_file in (map(Path, files) for files in CONTAINERS):
        try:
            limit = limit_file.read_text(encoding="utf-8").strip()
            if limit != "max":
                cached = re.search(
                    r"^inactive_file (\d+)", (limit_file.parent / "memory.stat").read_text("utf-8"), re.M
                )
                free.append(float(limit) - float(use_file.read_text("utf-8")) + float(cached[1] if cached else 0))
        except OSError:  # no container of this kind
            continue
    if sys.platform != "win32":
        import resource

        address_space = resource.getrlimit(resource.RLIMIT_AS)[0]
        if address_space != resource.RLIM_INFINITY:
            free.append(address_space - float(psutil.Process().memory_info().vms))
    return max(min(free), 0.0)


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
    """The error to report where memory has run out; None for one of another kind. CPUs say so only where a limit is set."""
    if not isinstance(error, MemoryError | torch.OutOfMemoryError) and "allocate memory" not in str(error):
        return None
    size = re.search(r"allocate ([\d.]+ \w+)", str(error))
    less = "dataset.rays, dataset.samples, dataset.pixels, limits.batch or limits.chunk"
    found = f"no memory for {size[1] if size else 'a tensor'}"
    return InputError("memory", "", found, "what fits into it", f"give less of {less}, or a smaller model")


def keep_freed_memory() -> None:
    """Has the GNU C library keep freed memory. Otherwise every tensor above 128 kB gets newly mapped memory, with a fault
    for each page: a fifth of a training step."""
    if mallopt := _c_function("mallopt"):
        # One arena, so that the next forward pass reuses what the backward pass's thread frees.
        for setting, value in ((_M_MMAP_THRESHOLD, 32 << 20), (_M_TRIM_THRESHOLD, 1 << 30), (_M_ARENA_MAX, 1)):
            mallopt(setting, value)


def give_back_freed_memory() -> None:
    """Returns kept memory to the system, where the C library can: between kinds of work, which need it in other pieces."""
    if trim := _c_function("malloc_trim"):
        trim(0)


def _c_function(name: str) -> "ctypes._NamedFuncPointer | None":
    """A function of the C library; None on Windows, macOS and musl, which do not have it."""
    try:
        return getattr(ctypes.CDLL(None), name)
    except (OSError, TypeError, AttributeError):
        return None
