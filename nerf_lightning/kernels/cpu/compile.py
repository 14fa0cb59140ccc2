"""How the CPU kernels are compiled."""

from collections.abc import Callable
from functools import partial

import numba
import torch
from numba.core.dispatcher import Dispatcher

# No fast maths. Numba optimises a function again for every other one it is linked into, and a process that compiles a kernel
# runs another copy than one that loads it from the cache: where the optimiser may reorder or fuse, their last bits differ.
# Vector code is written out instead: see `lanes`.
inner = partial(numba.njit, cache=True, error_model="numpy")
"""Decorates functions that kernels call."""


def kernel(function: Callable) -> Dispatcher:
    """Decorates an entry point; its argument `workers` is the number of pieces its work is split into."""
    return inner(function, parallel=True)


def workers() -> int:
    """Threads to use: as many as torch."""
    asked = torch.get_num_threads()
    threads = min(asked, numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(threads)
    if torch.get_num_threads() != asked:  # both use OpenMP, and numba's start gives torch all cores too
        torch.set_num_threads(asked)
    return threads
