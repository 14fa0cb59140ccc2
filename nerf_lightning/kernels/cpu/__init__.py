"""Fast CPU kernels, compiled by numba on first use and cached on disk; `nerf_lightning.kernels` documents each.

Samples are the last axis ([F, N]), so that loops over samples are long and contiguous. Work is split by the number of threads
alone, not by load: the same seed and number of threads give the same bits.
"""

from importlib import import_module
from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    """Imports kernels lazily, so that numba loads only if a fast version runs."""
    if name.startswith("_"):
        raise AttributeError(name)
    return import_module(f"{__name__}.{name}")
