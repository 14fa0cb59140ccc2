"""Activations of a kernel's outputs."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

Activation = Callable[[Tensor], Tensor] | None
"""None: the identity."""


def _at_least_single(x: Tensor) -> Tensor:
    """Casts half precision to float32: float16 overflows above e^11."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(_at_least_single(x).clamp_max(15.0))

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        grad_input = grad * torch.exp(_at_least_single(x).clamp(-15.0, 15.0))
        if grad_input.dtype == x.dtype:
            return grad_input
        limit = torch.finfo(x.dtype).max
        return grad_input.clamp(-limit, limit).to(x.dtype)


def truncated_exp(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """exp(min(x, 15)) with a gradient that neither vanishes nor overflows (Instant-NGP); float32 for half precision."""
    return _TruncatedExp.apply(x)


def activate(x: Tensor, activation: Activation, scale: float) -> Tensor:
    """`activation`, divided by a scale."""
    x = x if activation is None else activation(x)
    return x if scale == 1 else x / scale
