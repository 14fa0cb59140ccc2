"""Weights of a proposal field, and the loss that trains it (mip-NeRF 360, Barron et al. 2022)."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import gpu
from nerf_lightning.kernels.backend import has_gpu_kernel
from nerf_lightning.kernels.composite import interval_weights

WEIGHT_EPS = 1e-5
"""Added to weights by which excess is divided."""


def proposal_weights_reference(features: Tensor, dt: Tensor, bias: float, unit_length: float) -> Tensor:
    """`proposal_weights` in plain PyTorch, for every device."""
    return interval_weights(torch.exp(features.sum(1) + bias).view(dt.shape) * (dt / unit_length))


def proposal_weights(
    features: Float[Tensor, "N L"], dt: Float[Tensor, "R S"], bias: float, unit_length: float
) -> Float[Tensor, "R S"]:
    """Rendering weights of N = R S intervals, see `volume_weights`.

    Args:
        features: add up to the log-density (1 / unit_length), with `bias`.
        dt: interval lengths, world units.
        unit_length: in world units.
    """
    if has_gpu_kernel(features, constants=(dt,)) and gpu.resampling.is_supported(dt):
        return gpu.resampling.IntervalWeights.apply(features, dt, bias, unit_length)
    return proposal_weights_reference(features, dt, bias, unit_length)


def interlevel_loss_reference(
    proposed_weights: Tensor, proposed_edges: Tensor, edges: Tensor, weights: Tensor
) -> Tensor:
    """`interlevel_loss` in plain PyTorch, for every device."""
    last = proposed_weights.shape[1]
    sums = torch.nn.functional.pad(proposed_weights.cumsum(1), (1, 0))
    proposed_edges = proposed_edges.contiguous()
    low = (torch.searchsorted(proposed_edges, edges[:, :-1].contiguous(), right=True) - 1).clamp(0, last)
    high = torch.searchsorted(proposed_edges, edges[:, 1:].contiguous()).clamp(0, last)
    bound = sums.gather(1, high) - sums.gather(1, low)
    return ((weights - bound).clamp_min(0) ** 2 / (weights + WEIGHT_EPS)).sum(1).mean()


def interlevel_loss(
    proposed_weights: Float[Tensor, "R S"],
    proposed_edges: Float[Tensor, "R S_plus_1"],
    edges: Float[Tensor, "R K_plus_1"],
    weights: Float[Tensor, "R K"],
) -> Float[Tensor, ""]:
    """Interlevel loss, mip-NeRF 360 eq. 12 and 13, mean over rays: penalizes weight above the proposal histogram's bound.

    Args:
        proposed_weights, proposed_edges: intervals of the proposal field; the weights have the gradient.
        edges, weights: intervals of the main field.
    """
    constants = proposed_edges, edges, weights
    if has_gpu_kernel(proposed_weights, constants=constants) and gpu.resampling.is_supported(proposed_weights, weights):
        return gpu.resampling.InterlevelLoss.apply(proposed_weights, *constants)
    return interlevel_loss_reference(proposed_weights, *constants)
