"""Merging of adjacent low-weight samples."""

import math

from numba import prange

from nerf_lightning.kernels.cpu.jit import kernel


@kernel
def select_pairs(optical_depth, t, dt, offsets, min_weight, max_distance, weight_fraction, counts):
    """Selects samples to merge into their predecessors, and counts the remaining ones per ray [R].

    Args:
        min_weight, max_distance: see `nerf_lightning.kernels.merge`.
        weight_fraction: [N], the sample's fraction of the merged weight; -1 for samples that are not merged.
    """
    for ray in prange(len(offsets) - 1):
        optical, through, before, is_merged, kept = 0.0, 1.0, 0.0, False, 0
        for n in range(offsets[ray], offsets[ray + 1]):
            optical += optical_depth[n]
            behind = math.exp(-optical)
            weight = through - behind
            combined = before + weight
            is_merged = n > offsets[ray] and not is_merged and t[n] - t[n - 1] < max_distance * (dt[n] + dt[n - 1])
            is_merged = is_merged and min(before, weight) < min_weight and combined < 2  # False for NaN
            weight_fraction[n] = (weight / combined if combined > 0 else 0.0) if is_merged else -1.0
            kept += not is_merged
            through, before = behind, weight
        counts[ray] = kept


@kernel
def merge_pairs(weight_fraction, offsets, kept_offsets, optical_depth, t, dt, out, out_ray):
    """Packs optical depth, t and dt of the remaining samples into out [3, K]."""
    for ray in prange(len(offsets) - 1):
        row = kept_offsets[ray] - 1
        for n in range(offsets[ray], offsets[ray + 1]):
            if weight_fraction[n] < 0:
                row += 1
                out[0, row], out[1, row], out[2, row], out_ray[row] = optical_depth[n], t[n], dt[n], ray
            else:
                out[0, row] += optical_depth[n]
                out[1, row] += weight_fraction[n] * (t[n] - t[n - 1])
                out[2, row] += dt[n]
