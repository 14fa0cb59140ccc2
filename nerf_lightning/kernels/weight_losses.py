"""Regularization losses on rendering weights: distortion, density near cameras, view-dependent color."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import gpu
from nerf_lightning.kernels.backend import has_gpu_kernel
from nerf_lightning.kernels.march import Packed
from nerf_lightning.kernels.segment_sums import exclusive_sum

NEAR_LOSS_POWER = 4
"""Exponent of the nearness: weight inside the box is hardly penalized."""
TEXTURELESS_WEIGHT = 10.0
"""Weight of the L1 term (textureless regions only) relative to the L2 term."""
RESIDUAL_EPS = 1e-3
"""Residual norm below which the L1 term is smoothed."""


def distortion_loss(weight: Float[Tensor, "N"], packed: Packed, scale: float) -> Float[Tensor, ""]:
    """Distortion loss (mip-NeRF 360, eq. 15), mean over rays of sum_ij w_i w_j |s_i - s_j| + sum_i w_i^2 d_i / 3.

    Linear time, as samples are sorted along their ray. s = t / (t + scale), so that far content does not dominate.

    Args:
        weight: rendering weights, see `volume_weights`.
        packed: midpoints, lengths, rays and offsets of the samples, on R rays.
        scale: distance that maps to 0.5, world units.
    """
    t, dt, ray, offsets = packed
    if not len(t):
        return weight.sum()
    s = t / (t + scale)
    width = dt * scale / (t + scale) ** 2
    passed, far = exclusive_sum(torch.stack([weight, weight * s], dim=1), ray, offsets).unbind(1)
    pair_distance = 2 * weight * (s * passed - far)
    return (pair_distance + weight**2 * width / 3).sum() / (len(offsets) - 1)


def near_loss(weight: Float[Tensor, "N"], packed: Packed, scale: float) -> Float[Tensor, ""]:
    """Near loss, mean over rays of sum_i w_i n_i^4 with nearness n = scale / (t + scale).

    The depth of textureless surfaces is ambiguous, and training tends to place them close to a camera. FreeNeRF (Yang et al.
    2023, occlusion regularization) penalizes density within a fixed number of samples instead.

    Args:
        weight: rendering weights, see `volume_weights`.
        packed: midpoints, lengths, rays and offsets of the samples, on R rays.
        scale: distance at which n is 0.5, world units.
    """
    t, _, _, offsets = packed
    nearness = scale / (t + scale)
    return (weight * nearness**NEAR_LOSS_POWER).sum() / (len(offsets) - 1)


def view_loss(
    weight: Float[Tensor, "N"],
    view_residual: Float[Tensor, "N 3"],
    packed: Packed,
    texturelessness: Float[Tensor, "R"] | None = None,
) -> Float[Tensor, ""]:
    """View loss, mean over rays of sum_i w_i (|v_i|^2 + 10 p |v_i|) with view residual v.

    Unconstrained view dependence can explain every photo with wrong geometry (shape-radiance ambiguity). This regularizer
    keeps color view-independent unless a highlight explains many pixels; where photos are textureless even a small residual
    can move a surface, and the L1 term keeps it at zero.

    Args:
        weight: rendering weights, see `volume_weights`; detached.
        view_residual: see `FieldOutput`.
        packed: midpoints, lengths, rays and offsets of the samples, on R rays.
        texturelessness: p of each ray, see `RayBatch.texturelessness`; None for 0.
    """
    _, _, ray, offsets = packed
    squares = view_residual.square().sum(1)
    penalty = squares
    if texturelessness is not None:
        size = (squares + RESIDUAL_EPS**2).sqrt() - RESIDUAL_EPS  # smooth at 0
        penalty = squares + TEXTURELESS_WEIGHT * texturelessness.index_select(0, ray) * size
    return (weight.detach() * penalty).sum() / (len(offsets) - 1)


def weight_losses_reference(
    weight: Tensor, view_residual: Tensor | None, packed: Packed, scale: float,
    factors: tuple[float, float, float], texturelessness: Tensor | None = None,
) -> list[Tensor | None]:  # fmt: skip
    """`weight_losses` in plain PyTorch, for every device."""
    distortion_factor, near_factor, view_factor = factors
    view = None
    if view_factor and view_residual is not None:
        view = view_factor * view_loss(weight, view_residual, packed, texturelessness)
    return [
        distortion_factor * distortion_loss(weight, packed, scale) if distortion_factor else None,
        near_factor * near_loss(weight, packed, scale) if near_factor else None,
        view,
    ]


def weight_losses(
    weight: Float[Tensor, "N"],
    view_residual: Float[Tensor, "N 3"] | None,
    packed: Packed,
    scale: float,
    factors: tuple[float, float, float],
    texturelessness: Float[Tensor, "R"] | None = None,
) -> dict[str, Float[Tensor, ""]]:
    """Distortion, near and view loss, each times its factor, by name; none for a factor of 0. See each for the arguments."""
    found: Sequence[Tensor | None]
    if (
        view_residual is not None
        and texturelessness is not None
        and has_gpu_kernel(weight, view_residual, constants=(*packed[:2], texturelessness))
    ):
        found = gpu.weight_losses.WeightLosses.apply(weight, view_residual, packed, scale, factors, texturelessness)
    else:
        found = weight_losses_reference(weight, view_residual, packed, scale, factors, texturelessness)
    terms = zip(("distortion", "near", "view"), found, factors, strict=True)
    return {name: loss for name, loss, factor in terms if factor and loss is not None}
