"""Free memory, checks against it (the system kills processes silently), and C allocator settings."""

import ctypes
import re
from contextlib import suppress
from pathlib import Path

import psutil
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import CPU

CGROUP_FOLDER = Path("/sys/fs/cgroup")
"""Memory limits of a Linux container."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h of the GNU C library


def free_memory(device: torch.device = CPU) -> float:
    """Free bytes: of an accelerator, or of the machine within its container's limit."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    if device.type == "mps":
        return float(torch.mps.recommended_max_memory() - torch.mps.driver_allocated_memory())
    free = float(psutil.virtual_memory().available)
    try:
        limit, used, details = ((CGROUP_FOLDER / f"memory.{name}").read_text() for name in ("max", "current", "stat"))
    except OSError:  # no container
        return free
    if limit.strip() == "max":
        return free
    cached = re.search(r"^inactive_file (\d+)", details, re.M)
    return max(min(free, float(limit) - float(used) + float(cached[1] if cached else 0)), 0.0)


def fits_in_memory(size: int, device: torch.device) -> bool:
    """Whether `size` bytes fit into half of an accelerator's free memory; always true on the CPU, which holds them already."""
    return device.type == "cpu" or size <= free_memory(device) / 2


def check_memory(
    where: object, key: str, item: str, size: float, hint: str = "give less", device: torch.device = CPU
) -> None:
    """Checks that an allocation fits into free memory.

    Args:
        where, key, hint: see `InputError`.
        item: what needs the memory, plural, for the message.
        size: lower bound, bytes.

    Raises:
        InputError: it does not.
    """
    free = free_memory(device)
    if not size <= free:
        needed, available = (f"{part / 2**30:,.1f} GiB" for part in (size, free))
        raise InputError(where, key, f"{item} need at least {needed}, and {available} are free", hint=hint)


def out_of_memory_error(error: BaseException) -> InputError | None:
    """Converts an out-of-memory error to an InputError; None for other errors. CPUs raise one only under a limit."""
    if not isinstance(error, MemoryError | torch.OutOfMemoryError) and "allocate memory" not in str(error):
        return None
    size = re.search(r"allocate ([\d.]+ \w+)", str(error))
    options = "dataset.rays, dataset.samples, dataset.pixels, limits.batch_scale or limits.chunk_samples"
    problem = f"no memory for {size[1] if size else 'a tensor'}"
    return InputError("memory", "", problem, hint=f"give less of {options}, or a smaller model")


def keep_freed_memory() -> None:
    """Makes the GNU C library reuse freed memory. By default each tensor above 128 kB is mapped anew, and its page faults
    take a fifth of a training step."""
    with suppress(OSError, TypeError, AttributeError):  # no mallopt: Windows, macOS, musl
        # One arena, so that the next forward pass reuses what the backward pass's thread frees.
        for setting, value in ((_M_MMAP_THRESHOLD, 32 << 20), (_M_TRIM_THRESHOLD, 1 << 30), (_M_ARENA_MAX, 1)):
            ctypes.CDLL(None).mallopt(setting, value)


def release_freed_memory() -> None:
    """Returns freed memory to the system, where the C library can; called between phases with different allocation sizes."""
    with suppress(OSError, TypeError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
