"""Merging of neighboring samples before color evaluation: low-weight ones, or their features."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.kernels import cpu
from nerf_lightning.kernels.backend import has_fast_kernel
from nerf_lightning.kernels.composite import PackedSelection, volume_weights
from nerf_lightning.kernels.march import Packed, offsets_from_counts

FeatureGroups = tuple[Float[Tensor, "G F"], Int[Tensor, "N"], Int[Tensor, "G"]]
"""Features of groups of samples, the group of each sample, and the ray of each group."""
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


def average_neighbors_reference(
    optical_depth: Tensor, features: Tensor, ray: Tensor, offsets: Tensor, size: int
) -> FeatureGroups:
    """`average_neighbors` in plain PyTorch, for every device."""
    weights = volume_weights(optical_depth, torch.ones_like(optical_depth), ray, offsets)[:, None] + 1e-10
    position = torch.arange(len(ray), device=ray.device) - offsets.index_select(0, ray)
    is_first = position % size == 0
    index, group_ray = is_first.cumsum(0) - 1, ray[is_first]
    values = torch.cat([weights * features, weights], dim=1)
    sums = values.new_zeros(len(group_ray), values.shape[1]).index_add_(0, index, values)
    return sums[:, :-1] / sums[:, -1:], index, group_ray


def average_neighbors(
    optical_depth: Float[Tensor, "N"],
    features: Float[Tensor, "N F"],
    ray: Int[Tensor, "N"],
    offsets: Int[Tensor, "R_plus_1"],
    size: int,
) -> FeatureGroups:
    """Mean features, by rendering weight, of every `size` consecutive samples of a ray; a ray's last group may be smaller.

    Args:
        optical_depth: optical depth of each sample, density times length.
        features: features of each sample.
        ray, offsets: see `volume_weights`.
    """
    if not has_fast_kernel(constants=(optical_depth, features)):
        return average_neighbors_reference(optical_depth, features, ray, offsets, size)
    counts = (offsets.diff() + size - 1) // size
    group_offsets = offsets_from_counts(counts)
    means, index = torch.empty(features.shape[1], int(group_offsets[-1])), torch.empty_like(ray)
    arguments = optical_depth, features.T, offsets, group_offsets, size, torch.empty(len(ray)), index, means
    cpu.composite.average_neighbors(*arguments)
    return means.T, index, torch.arange(len(counts)).repeat_interleave(counts)
