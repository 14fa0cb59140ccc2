"""Regularization losses on rendering weights: distortion, density near cameras, view-dependent color."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.segment_sums import exclusive_sum
from nerf_lightning.sampler import Samples

NEAR_LOSS_POWER = 4
"""Exponent of the nearness: weight inside the box is hardly penalized."""
NEAR_LOSS_END = 0.7
"""Training progress at which the near loss has faded out, so that surfaces it pushed back can recover."""
TEXTURELESS_WEIGHT = 10.0
"""Weight of the L1 term (textureless regions only) relative to the L2 term."""
RESIDUAL_EPS = 1e-3
"""Residual norm below which the L1 term is smoothed."""
AUTO_VIEW_LOSS_WEIGHT = {False: 0.01, True: 0.001}
"""Automatic weight of the view loss, by `unbounded`. A bounded subject was often turned before the camera, with the light
fixed; in unbounded scenes view dependence also absorbs exposure changes."""


def distortion_loss(weight: Float[Tensor, "N"], samples: Samples, scale: float) -> Float[Tensor, ""]:
    """Distortion loss (mip-NeRF 360, eq. 15), mean over rays of sum_ij w_i w_j |s_i - s_j| + sum_i w_i^2 d_i / 3.

    Linear time, as samples are sorted along their ray. s = t / (t + scale), so that far content does not dominate.

    Args:
        weight: rendering weights, see `volume_weights`.
        samples: samples on R rays.
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
    """Near loss, mean over rays of sum_i w_i n_i^4 with nearness n = scale / (t + scale).

    The depth of textureless surfaces is ambiguous, and training tends to place them close to a camera. FreeNeRF (Yang et al.
    2023, occlusion regularization) penalizes density within a fixed number of samples instead.

    Args:
        weight: rendering weights, see `volume_weights`.
        samples: samples on R rays.
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
    """View loss, mean over rays of sum_i w_i (|v_i|^2 + 10 p |v_i|) with view residual v.

    Unconstrained view dependence can explain every photo with wrong geometry (shape-radiance ambiguity). This regularizer
    keeps color view-independent unless a highlight explains many pixels; where photos are textureless even a small residual
    can move a surface, and the L1 term keeps it at zero.

    Args:
        weight: rendering weights, see `volume_weights`; detached.
        view_residual: see `FieldOutput`.
        samples: samples on R rays.
        texturelessness: p of each ray, see `RayBatch.texturelessness`; None for 0.
    """
    squares = view_residual.square().sum(1)
    penalty = squares
    if texturelessness is not None:
        size = (squares + RESIDUAL_EPS**2).sqrt() - RESIDUAL_EPS  # smooth at 0
        penalty = squares + TEXTURELESS_WEIGHT * texturelessness.index_select(0, samples.ray) * size
    return (weight.detach() * penalty).sum() / (len(samples.offsets) - 1)
