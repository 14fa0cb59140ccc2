"""Which version of a kernel runs: the plain-torch reference, or the fast one for CPUs."""

import torch
from torch import Tensor

from nerf_lightning.errors import InputError

_allowed = True


def use_kernels(choice: str) -> None:
    """Sets the versions for this process: "auto" takes a fast one wherever it applies, "reference" never does.

    Raises:
        InputError: on any other choice.
    """
    global _allowed
    if choice not in ("auto", "reference"):
        raise InputError("config", "kernels", repr(choice), "auto or reference")
    _allowed = choice == "auto"


def chosen_kernels() -> str:
    """What `use_kernels` was told last."""
    return "auto" if _allowed else "reference"


def fast(*tensors: Tensor) -> bool:
    """Whether the fast version applies: it is allowed, and all floating tensors are single precision on a CPU."""
    return _allowed and all(
        tensor.device.type == "cpu" and (tensor.dtype == torch.float32 or not tensor.is_floating_point())
        for tensor in tensors
    )
