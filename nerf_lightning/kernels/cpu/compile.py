"""How the CPU kernels are compiled."""

from functools import partial

import numba
import torch

# Sums may be reordered and contracted, which vector units need; not-a-numbers must stay visible.
FASTMATH = {"reassoc", "contract", "nsz", "arcp"}

inner = partial(numba.njit, cache=True, fastmath=FASTMATH, error_model="numpy")
"""Decorates what is called within a kernel."""
kernel = partial(numba.njit, cache=True, fastmath=FASTMATH, error_model="numpy", parallel=True)
"""Decorates an entry point; `workers` says into how many pieces it cuts its work."""
exact = partial(numba.njit, cache=True, error_model="numpy", parallel=True)
"""Like `kernel`, but rounding step by step as torch does: for decisions that must not differ from the reference's."""


def workers() -> int:
    """Threads to use: as many as torch."""
    asked = torch.get_num_threads()
    threads = min(asked, numba.config.NUMBA_NUM_THREADS)
    numba.set_num_threads(threads)
    if torch.get_num_threads() != asked:  # both stand on OpenMP, and numba's first start takes all cores for torch too
        torch.set_num_threads(asked)
    return threads
