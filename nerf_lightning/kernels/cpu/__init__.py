"""Fast versions for CPUs, compiled by numba on first use and cached on disk; the modules one level up say what each does.

Here features and coordinates come first and samples last ([F, N]), so that loops over samples are long and contiguous.
Work is split by the number of threads alone, never at random or by load: the same seed and threads give the same bits.
"""

from importlib import import_module
from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    """Imports a module when it is first used: where no fast version runs, nobody waits for numba."""
    if name.startswith("_"):
        raise AttributeError(name)
    return import_module(f"{__name__}.{name}")
