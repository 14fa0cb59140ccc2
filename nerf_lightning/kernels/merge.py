"""Merging of neighboring samples of low weight before color evaluation."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.composite import PackedSelection, volume_weights
from nerf_lightning.kernels.march import Packed, offsets_from_counts

MergedSamples = tuple[Float[Tensor, "K"], PackedSelection]
"""Optical depth of the K remaining samples, and their intervals."""
MAX_MIDPOINT_DISTANCE = 0.625
"""Maximum distance of adjacent midpoints relative to the sum of lengths: 0.5 if they touch, 0.75 or more with a gap."""


def merge_low_weight_reference(optical_depth: Tensor, packed: Packed, min_weight: float) -> MergedSamples:
    """`merge_low_weight` in plain PyTorch, for every device."""
    t, dt, ray, offsets = packed
    weights = volume_weights(optical_depth, torch.ones_like(optical_depth), ray, offsets)
    previous, current = weights[:-1], weights[1:]
    near = (ray[1:] == ray[:-1]) & (t[1:] - t[:-1] < MAX_MIDPOINT_DISTANCE * (dt[1:] + dt[:-1]))
    mergeable = torch.zeros_like(ray, dtype=torch.bool)
    mergeable[1:] = near & (torch.minimum(previous, current) < min_weight) & (previous + current < 2)
    # Of several mergeable samples in a row, every second one is merged.
    position = torch.arange(len(ray), device=ray.device)
    chain_start = torch.where(mergeable, 0, position).cummax(0).values if len(ray) else position
    is_merged = mergeable & ((position - chain_start) % 2 == 1)
    index, kept = (~is_merged).nonzero()[:, 0], offsets_from_counts(~is_merged).index_select(0, offsets)

    def merge_values(values: Tensor, increments: Tensor) -> Tensor:
        """Values of the remaining samples plus the increments of samples merged into them."""
        increment = torch.where(is_merged, increments, 0.0).roll(-1)  # the first is never merged
        return (values + increment).index_select(0, index)

    weight_fraction = weights / (weights + weights.roll(1)).clamp_min(1e-30)
    merged_t = merge_values(t, weight_fraction * (t - t.roll(1)))
    packed = merged_t, merge_values(dt, dt), ray.index_select(0, index), kept
    return merge_values(optical_depth, optical_depth), packed


def merge_low_weight(optical_depth: Float[Tensor, "N"], packed: Packed, min_weight: float) -> MergedSamples:
    """Merges a sample into its predecessor if the weight of either is below `min_weight`, at most two into one.

    The merged interval has the summed length and optical depth, which preserves opacity, and the weighted mean of t, which
    preserves depth. Only the color is evaluated at one position instead of two.

    Args:
        optical_depth: optical depth of each sample, density times length.
        packed: midpoints, lengths, rays and offsets of N samples; only adjacent ones are merged.
        min_weight: minimum rendering weight, see `volume_weights`.
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
