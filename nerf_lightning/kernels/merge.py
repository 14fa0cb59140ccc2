"""Fewer samples along rays: one that hardly counts and the one beside it become one."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.composite import VisibleSamples, volume_weights
from nerf_lightning.kernels.march import Packed, offsets_from_counts

MAX_MIDPOINT_DISTANCE = 0.625
"""Distance between the midpoints of neighbours, as a share of their lengths together: 0.5 if they touch, and 0.75 at least with
one of equal length between them."""


def merge_low_weight_reference(optical_depth: Tensor, packed: Packed, min_weight: float) -> VisibleSamples:
    """`merge_low_weight` in plain PyTorch, for every device."""
    t, dt, ray, offsets = packed
    weights = volume_weights(optical_depth, torch.ones_like(optical_depth), ray, offsets)
    one, two = weights[:-1], weights[1:]
    near = (ray[1:] == ray[:-1]) & (t[1:] - t[:-1] < MAX_MIDPOINT_DISTANCE * (dt[1:] + dt[:-1]))
    could = torch.zeros_like(ray, dtype=torch.bool)
    could[1:] = near & (torch.minimum(one, two) < min_weight) & (one + two < 2)
    # Of several in a row that could, every second one does.
    place = torch.arange(len(ray), device=ray.device)
    chain = torch.where(could, 0, place).cummax(0).values if len(ray) else place
    joins = could & ((place - chain) % 2 == 1)
    index, kept = (~joins).nonzero()[:, 0], offsets_from_counts(~joins).index_select(0, offsets)

    def kept_of(own: Tensor, added: Tensor) -> Tensor:
        """Of those that remain, with what the next one adds where that joins."""
        more = torch.where(joins, added, 0.0).roll(-1)  # the first never joins
        return (own + more).index_select(0, index)

    weight_fraction = weights / (weights + weights.roll(1)).clamp_min(1e-30)
    found = (kept_of(optical_depth, optical_depth), kept_of(t, weight_fraction * (t - t.roll(1))), kept_of(dt, dt))
    return found[0], (*found[1:], ray.index_select(0, index), kept)


def merge_low_weight(optical_depth: Float[Tensor, "N"], packed: Packed, min_weight: float) -> VisibleSamples:
    """Merges samples with the neighbour before them where the weight of either is below `min_weight`, at most two into one.

    The merged interval has the length and the thickness of both, so that opacity stays as it was, and its t is the mean by
    weights, so that depth does. Only the colour is asked at one place instead of two.

    Args:
        optical_depth: optical depth of each sample, density times length.
        packed: midpoints, lengths, rays and offsets of N samples. Only those that touch are merged.
        min_weight: weight, see `volume_weights`.
    """
    t, dt, _, offsets = packed
    if not has_fast_kernel(constants=(optical_depth, t, dt)):
        return merge_low_weight_reference(optical_depth, packed, min_weight)
    weight_fraction, counts = torch.empty(len(t)), torch.empty(len(offsets) - 1, dtype=torch.int64)
    cpu.merge.select_pairs(optical_depth, t, dt, offsets, min_weight, MAX_MIDPOINT_DISTANCE, weight_fraction, counts)
    kept = offsets_from_counts(counts)
    out, rays = torch.empty(3, int(kept[-1])), torch.empty(int(kept[-1]), dtype=torch.int64)
    cpu.merge.merge_pairs(weight_fraction, offsets, kept, optical_depth, t, dt, out, rays)
    return out[0], (out[1], out[2], rays, kept)
