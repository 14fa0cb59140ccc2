"""From a network's raw output to a density."""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor


def _at_least_single(x: Tensor) -> Tensor:
    """Half precision ends at e^11."""
    return x.to(torch.promote_types(x.dtype, torch.float32))


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(_at_least_single(x).clamp_max(15.0))

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        found = grad * torch.exp(_at_least_single(x).clamp(-15.0, 15.0))
        if found.dtype == x.dtype:
            return found
        most = torch.finfo(x.dtype).max
        return found.clamp(-most, most).to(x.dtype)


def truncated_exp(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """exp(x), at most e^15, with a gradient that neither vanishes nor overflows (Instant-NGP's density).

    Half-precision input gives single precision.
    """
    return _TruncatedExp.apply(x)


def shifted_softplus(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """softplus(x - 1) (Mip-NeRF, Barron et al. 2021): little density at the start, and a gradient everywhere."""
    return torch.nn.functional.softplus(x - 1.0)


class SoftenableReLU(torch.nn.Module):
    """ReLU, the original NeRF's density. Zero density has no gradient, so a field can die: `soften` is the way out."""

    is_soft = False

    def soften(self) -> None:
        """From now on `shifted_softplus`."""
        self.is_soft = True

    def forward(self, x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        return shifted_softplus(x) if self.is_soft else torch.relu(x)

    def get_extra_state(self) -> Tensor:
        """Saved in checkpoints, as it changes what the weights mean."""
        return torch.tensor(self.is_soft)

    def set_extra_state(self, state: Tensor) -> None:
        self.is_soft = bool(state)


Activation = Literal["relu", "softplus", "exp"]


def density_activation(name: Activation) -> Callable[[Tensor], Tensor]:
    """The map from raw output to density: "relu" (NeRF), "softplus" (Mip-NeRF, shifted by -1) or "exp" (truncated)."""
    return SoftenableReLU() if name == "relu" else {"softplus": shifted_softplus, "exp": truncated_exp}[name]
