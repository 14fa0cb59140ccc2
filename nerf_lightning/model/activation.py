"""From a network's raw output to a density."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.errors import InputError


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x.clamp_max(15.0))

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return grad * torch.exp(x.clamp(-15.0, 15.0))


def truncated_exp(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """exp(x), held at e^15 above, with a gradient that neither vanishes nor overflows (Instant-NGP's density)."""
    return _TruncatedExp.apply(x)


def density_activation(name: str) -> Callable[[Tensor], Tensor]:
    """The map from raw output to density: "relu" (NeRF), "softplus" (Mip-NeRF, shifted by -1) or "exp" (truncated).

    Raises:
        InputError: on any other name.
    """
    match name:
        case "relu":
            return torch.relu
        case "softplus":
            return lambda x: torch.nn.functional.softplus(x - 1.0)
        case "exp":
            return truncated_exp
    raise InputError("model.density", "", repr(name), "relu, softplus or exp")
