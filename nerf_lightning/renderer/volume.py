"""Volume rendering over packed samples, in pure functions."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def volume_weights(
    density: Float[Tensor, "N"], dt: Float[Tensor, "N"], ray: Int[Tensor, "N"], offsets: Int[Tensor, "R_plus_1"]
) -> Float[Tensor, "N"]:
    """How much each sample contributes to its ray's pixel (NeRF, eq. 3; Max 1995).

    w_i = T_i (1 - exp(-sigma_i dt_i)),  T_i = exp(-sum_{j < i} sigma_j dt_j), the sum within the sample's ray.

    Args:
        density: sigma, 1 / world unit, not negative.
        dt: interval lengths, world units.
        ray: ray of each sample, ascending.
        offsets: first sample of each ray, then N.

    Returns:
        Weights in [0, 1]; over a ray they add up to its opacity.
    """
    optical = density * dt
    # One running sum over all rays, less its value where the ray starts. In double: the sum outgrows single precision.
    total = torch.cat([optical.new_zeros(1, dtype=torch.float64), optical.double().cumsum(0)])
    before = total[:-1] - total[offsets[:-1]][ray]
    return torch.exp(-before).to(density.dtype) * -torch.expm1(-optical)


def accumulate(
    weights: Float[Tensor, "N"], values: Float[Tensor, "N D"], ray: Int[Tensor, "N"], rays: int
) -> Float[Tensor, "R D"]:
    """Weighted sum of the samples' values over each of `rays` rays; zero where a ray has none."""
    return values.new_zeros(rays, values.shape[1]).index_add(0, ray, weights[:, None] * values)
