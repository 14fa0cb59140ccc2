"""Kernel selection: the PyTorch reference, or the fast versions for CPUs and NVIDIA GPUs."""

import torch
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.kernels import gpu

_choice = "auto"


def set_kernels(choice: str) -> None:
    """Selects kernels for this process: "auto" uses fast versions where they apply, "reference" never.

    "triton" uses those for GPUs on every device: on CPU tensors, to check them, in Triton's interpreter.

    Raises:
        InputError: for any other choice.
    """
    global _choice
    if choice not in ("auto", "reference", "triton"):
        raise InputError("config", "kernels", repr(choice), "auto or reference")
    _choice = choice


def get_kernels() -> str:
    """Current choice of `set_kernels`."""
    return _choice


def has_fast_kernel(*tensors: Tensor, constants: tuple[Tensor, ...] = ()) -> bool:
    """Whether the fast CPU version applies: it is enabled, and all floating tensors are float32 on a CPU.

    Args:
        constants: further tensors, for which it has no gradient.
    """
    return (
        _choice == "auto" and _are_float32("cpu", *tensors, *constants) and not any(x.requires_grad for x in constants)
    )


def has_gpu_kernel(*tensors: Tensor, constants: tuple[Tensor, ...] = ()) -> bool:
    """Whether the GPU version applies: all floating tensors are float32 on an NVIDIA GPU that passes `gpu.self_test`.

    Args:
        constants: further tensors, for which it has no gradient.
    """
    inputs = (*tensors, *constants)
    if any(x.requires_grad for x in constants):
        return False
    if _choice == "triton":
        return _are_float32(inputs[0].device.type, *inputs)
    return _choice == "auto" and _are_float32("cuda", *inputs) and gpu.self_test.is_passed(inputs[0].device)


def _are_float32(device: str, *tensors: Tensor) -> bool:
    return all(x.device.type == device and (x.dtype == torch.float32 or not x.is_floating_point()) for x in tensors)
