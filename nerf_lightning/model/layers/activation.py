"""Density activations."""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import truncated_exp


def shifted_softplus(x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """softplus(x - 1) (Mip-NeRF, Barron et al. 2021): low initial density, nonzero gradient everywhere."""
    return torch.nn.functional.softplus(x - 1.0)


class SoftenableReLU(torch.nn.Module):
    """ReLU, the original NeRF's density. Zero density has no gradient, so a field can die: `soften` replaces it."""

    is_soft = False

    def soften(self) -> None:
        """Switches to `shifted_softplus`."""
        self.is_soft = True

    def forward(self, x: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
        return shifted_softplus(x) if self.is_soft else torch.relu(x)

    def get_extra_state(self) -> Tensor:
        """Checkpoints store `is_soft`, as it changes the meaning of the weights."""
        return torch.tensor(self.is_soft)

    def set_extra_state(self, state: Tensor) -> None:
        self.is_soft = bool(state)


Activation = Literal["relu", "softplus", "exp"]


def density_activation(name: Activation) -> Callable[[Tensor], Tensor]:
    """Density activation: "relu" (NeRF), "softplus" (Mip-NeRF, shifted by -1) or "exp" (truncated)."""
    return SoftenableReLU() if name == "relu" else {"softplus": shifted_softplus, "exp": truncated_exp}[name]
