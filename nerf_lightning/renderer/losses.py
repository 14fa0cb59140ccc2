"""Regularization losses on the rendering weights: fog, walls before the cameras, colours that differ from every side."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.segment_sums import exclusive_sum
from nerf_lightning.sampler import Samples

NEAR_LOSS_POWER = 4
"""Power of the nearness that weight is penalised with: what stands at the box is hardly touched."""
NEAR_LOSS_END = 0.7
"""Share of the training in which the near loss fades out: surfaces that it pushed back then find their place."""
TEXTURELESS_WEIGHT = 10.0
"""What a view residual costs by its size where photos are textureless, in what it costs by its square everywhere."""
RESIDUAL_EPS = 1e-3
"""Size of a view residual below which its price falls off."""
AUTO_VIEW_LOSS_WEIGHT = {False: 0.01, True: 0.001}
"""Weight of the view loss, without and with a background. A subject that stands alone was often turned before the camera,
so that its light did not turn with it; before a background, the direction also stands for a changing exposure."""


def distortion_loss(weight: Float[Tensor, "N"], samples: Samples, scale: float) -> Float[Tensor, ""]:
    """Mean over rays of sum_ij w_i w_j |s_i - s_j| + sum_i w_i^2 d_i / 3: how far a ray's weights are spread.

    Barron et al. 2022, "Mip-NeRF 360", eq. 15; in linear time, since samples are sorted along their ray. Distances are
    mapped to s = t / (t + scale), so that far content does not dominate.

    Args:
        weight: of the samples, see `volume_weights`.
        samples: along R rays.
        scale: distance that maps to 0.5, world units.
    """
    if not len(samples):
        return weight.sum()
    s = samples.t / (samples.t + scale)
    width = samples.dt * scale / (samples.t + scale) ** 2
    passed, far = exclusive_sum(torch.stack([weight, weight * s], dim=1), samples.ray, samples.offsets).unbind(1)
    pair_distance = 2 * weight * (s * passed - far)
    return (pair_distance + weight**2 * width / 3).sum() / (len(samples.offsets) - 1)


def near_loss(weight: Float[Tensor, "N"], samples: Samples, scale: float) -> Float[Tensor, ""]:
    """Mean over rays of sum_i w_i n_i^4, where n = scale / (t + scale) is 1 at the camera and falls with the distance.

    Where photos alone do not tell how far a plain surface is, a place nearer to a camera explains its pixels as well, and
    training starts there. A small price on nearness tips the balance. Yang et al. 2023, "FreeNeRF", penalise density
    within a fixed number of samples of the camera (occlusion regularization); this one needs no such number.

    Args:
        weight: of the samples, see `volume_weights`.
        samples: along R rays.
        scale: distance at which n is 0.5, world units.
    """
    nearness = scale / (samples.t + scale)
    return (weight * nearness**NEAR_LOSS_POWER).sum() / (len(samples.offsets) - 1)


def view_loss(
    weight: Float[Tensor, "N"],
    view_residual: Float[Tensor, "N 3"],
    samples: Samples,
    texturelessness: Float[Tensor, "R"] | None = None,
) -> Float[Tensor, ""]:
    """Mean over rays of sum_i w_i (|v_i|^2 + 10 p |v_i|), where v is what the direction adds to the logits of the colour.

    A place that may look different from every side can show each photo what it wants to see, wherever it stands. A price on
    that keeps surfaces where all photos agree; a highlight that explains many pixels still pays. Where photos are plain, even
    a little is enough to move a surface, and a price on the size itself keeps it at none.

    Args:
        weight: of the samples, see `volume_weights`; no gradient goes there.
        view_residual: see `FieldOutput`.
        samples: along R rays.
        texturelessness: p of each ray, see `RayBatch.texturelessness`; None for 0.
    """
    squares = view_residual.square().sum(1)
    price = squares
    if texturelessness is not None:
        size = (squares + RESIDUAL_EPS**2).sqrt() - RESIDUAL_EPS  # with a gradient where there is none
        price = squares + TEXTURELESS_WEIGHT * texturelessness.index_select(0, samples.ray) * size
    return (weight.detach() * price).sum() / (len(samples.offsets) - 1)
