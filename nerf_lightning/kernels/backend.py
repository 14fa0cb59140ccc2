"""Which version of a kernel runs: the plain PyTorch reference, or the fast one for CPUs."""

import torch
from torch import Tensor

from nerf_lightning.errors import InputError

_allowed = True


def set_kernels(choice: str) -> None:
    """Sets the version for this process: "auto" uses the fast one wherever it applies, "reference" never.

    Raises:
        InputError: on any other choice.
    """
    global _allowed
    if choice not in ("auto", "reference"):
        raise InputError("config", "kernels", repr(choice), "auto or reference")
    _allowed = choice == "auto"


def get_kernels() -> str:
    """The last choice given to `set_kernels`."""
    return "auto" if _allowed else "reference"


def has_fast_kernel(*tensors: Tensor, constants: tuple[Tensor, ...] = ()) -> bool:
    """Whether the fast version applies: it is allowed, and all floating tensors are single precision on a CPU.

    Args:
        constants: further tensors, for which it has no gradient.
    """
    given = (*tensors, *constants)
    single = all(x.device.type == "cpu" and (x.dtype == torch.float32 or not x.is_floating_point()) for x in given)
    return _allowed and single and not any(x.requires_grad for x in constants)
