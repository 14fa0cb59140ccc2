"""Fast kernels for NVIDIA GPUs, written in Triton; `nerf_lightning.kernels` documents each.

`launch` compiles and starts them without a C compiler. On CPU tensors they run in Triton's interpreter (`TRITON_INTERPRET=1`),
which is how they are tested.
"""

from importlib import import_module
from types import ModuleType


def __getattr__(name: str) -> ModuleType:
    """Imports kernels lazily, so that Triton loads only if one of them runs."""
    if name.startswith("_"):
        raise AttributeError(name)
    return import_module(f"{__name__}.{name}")
