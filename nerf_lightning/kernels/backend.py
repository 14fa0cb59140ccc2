"""Kernel selection: the PyTorch reference or the fast CPU version."""

import torch
from torch import Tensor

from nerf_lightning.errors import InputError

_allowed = True


def set_kernels(choice: str) -> None:
    """Selects kernels for this process: "auto" uses fast versions where they apply, "reference" never.

    Raises:
        InputError: for any other choice.
    """
    global _allowed
    if choice not in ("auto", "reference"):
        raise InputError("config", "kernels", repr(choice), "auto or reference")
    _allowed = choice == "auto"


def get_kernels() -> str:
    """Current choice of `set_kernels`."""
    return "auto" if _allowed else "reference"


def has_fast_kernel(*tensors: Tensor, constants: tuple[Tensor, ...] = ()) -> bool:
    """Whether the fast version applies: it is enabled, and all floating tensors are float32 on a CPU.

    Args:
        constants: further tensors, for which it has no gradient.
    """
    inputs = (*tensors, *constants)
    is_fast = all(x.device.type == "cpu" and (x.dtype == torch.float32 or not x.is_floating_point()) for x in inputs)
    return _allowed and is_fast and not any(x.requires_grad for x in constants)
