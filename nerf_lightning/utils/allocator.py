"""What large tensors on a CPU want of the C allocator."""

import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -3, -8  # malloc.h of the GNU C library
_LARGEST_MMAP_THRESHOLD = 32 << 20


def keep_freed_memory() -> bool:
    """Tells the C library to keep freed memory instead of returning it to the system after each step.

    By default every tensor above 128 kB gets newly mapped memory, with a fault for each page: a fifth of a training step.

    Returns:
        Whether the C library accepted it; only the GNU one does.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, TypeError, AttributeError):  # Windows, macOS, musl: their allocators have no such knob
        return False
    # One arena, so that the next forward pass reuses what the backward pass's thread frees.
    settings = ((_M_MMAP_THRESHOLD, _LARGEST_MMAP_THRESHOLD), (_M_TRIM_THRESHOLD, 1 << 30), (_M_ARENA_MAX, 1))
    taken = [mallopt(setting, value) for setting, value in settings]
    return all(taken)


def give_back_freed_memory() -> None:
    """Returns kept memory to the system, where the C library can: between kinds of work, which need it in other pieces."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (OSError, TypeError, AttributeError):  # as above
        return
    trim(0)
