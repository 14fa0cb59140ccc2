"""How the CPU kernels are compiled."""

import functools
import inspect
import threading
from collections.abc import Callable

import numba
import torch

# No fast maths. Numba optimises a function again for every other one it is linked into, and a process that compiles a kernel
# runs another copy than one that loads it from the cache: where the optimiser may reorder or fuse, their last bits differ.
# Vector code is written out instead: see `lanes`.
jit = functools.partial(numba.njit, cache=True, error_model="numpy")
"""Decorates functions that kernels call."""


def kernel(function: Callable) -> Callable:
    """Decorates an entry point: it takes tensors, as contiguous arrays, and runs on as many threads as torch.

    What it fills has to be contiguous already: of any other tensor it would fill a copy. An argument `workers`, the last, is
    not given by callers: it is the number of pieces that the work is to be split into.
    """
    compiled, takes_workers = jit(function, parallel=True), "workers" in inspect.signature(function).parameters

    @functools.wraps(function)
    def run(*arguments):
        # A step makes some forty calls of up to thirty arguments, so each conversion that is not needed shows.
        given = [
            (x.detach() if x.requires_grad else x).contiguous().numpy() if isinstance(x, torch.Tensor) else x
            for x in arguments
        ]
        pieces = sync_num_threads()
        compiled(*given, pieces) if takes_workers else compiled(*given)

    return run


class _Threads(threading.local):
    """What numba was told last: it keeps a number of threads for each thread, behind a lock."""

    torch = numba = 0


_threads = _Threads()


def sync_num_threads() -> int:
    """Sets numba's number of threads to torch's, and returns it."""
    asked = torch.get_num_threads()
    if asked != _threads.torch:
        _threads.torch, _threads.numba = asked, min(asked, numba.config.NUMBA_NUM_THREADS)
        numba.set_num_threads(_threads.numba)
        if torch.get_num_threads() != asked:  # both use OpenMP, and numba's start gives torch all cores too
            torch.set_num_threads(asked)
    return _threads.numba
