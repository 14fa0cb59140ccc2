"""A penalty on weight that is spread along a ray: fog and floaters (mip-NeRF 360)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import volume_weights
from nerf_lightning.kernels.sums import before
from nerf_lightning.sampler import Samples


def distortion_loss(density: Float[Tensor, "N"], samples: Samples, scale: float) -> Float[Tensor, ""]:
    """Mean over rays of sum_ij w_i w_j |s_i - s_j| + sum_i w_i^2 d_i / 3: how far a ray's weights are spread.

    Barron et al. 2022, "Mip-NeRF 360", eq. 15; in linear time, since samples are sorted along their ray. Distances are
    mapped to s = t / (t + scale), so that far content does not dominate.

    Args:
        density: of the samples, 1 / world unit.
        samples: along R rays.
        scale: distance that maps to 0.5, world units.
    """
    if not len(samples):
        return density.sum()
    weight = volume_weights(density, samples.dt, samples.ray, samples.offsets)
    s = samples.t / (samples.t + scale)
    width = samples.dt * scale / (samples.t + scale) ** 2
    passed, far = before(torch.stack([weight, weight * s], dim=1), samples.ray, samples.offsets).unbind(1)
    apart = 2 * weight * (s * passed - far)
    return (apart + weight**2 * width / 3).sum() / (len(samples.offsets) - 1)
