"""Compilation of the CPU kernels."""

import functools
import inspect
import threading
from collections.abc import Callable

import numba
import torch

# No fastmath: numba optimizes a function again in every caller, and compiled and cached copies would differ in the last bits
# where the optimizer may reorder or fuse. Vector code is explicit instead, see `simd`.
jit = functools.partial(numba.njit, cache=True, error_model="numpy")
"""Decorator of functions called by kernels."""


def kernel(function: Callable) -> Callable:
    """Decorator of kernel entry points: passes tensors as contiguous arrays and uses torch's number of threads.

    Outputs must be contiguous: otherwise a copy would be filled. The decorator appends the last argument, `workers`, if the
    kernel has one: the number of parallel chunks.
    """
    compiled, takes_workers = jit(function, parallel=True), "workers" in inspect.signature(function).parameters

    @functools.wraps(function)
    def run(*arguments):
        # A step makes about forty calls of up to thirty arguments: avoid needless conversions.
        arrays = [
            (x.detach() if x.requires_grad else x).contiguous().numpy() if isinstance(x, torch.Tensor) else x
            for x in arguments
        ]
        pieces = sync_num_threads()
        compiled(*arrays, pieces) if takes_workers else compiled(*arrays)

    return run


class _Threads(threading.local):
    """Cache of the thread counts: numba keeps one per thread, behind a lock."""

    torch = numba = 0


_threads = _Threads()


def sync_num_threads() -> int:
    """Sets numba's number of threads to torch's and returns it."""
    num_threads = torch.get_num_threads()
    if num_threads != _threads.torch:
        _threads.torch, _threads.numba = num_threads, min(num_threads, numba.config.NUMBA_NUM_THREADS)
        numba.set_num_threads(_threads.numba)
        if torch.get_num_threads() != num_threads:  # starting numba's OpenMP resets torch's count
            torch.set_num_threads(num_threads)
    return _threads.numba
