"""Merging of neighbouring samples of which one hardly counts."""

import math

from numba import prange

from nerf_lightning.kernels.cpu.jit import kernel


@kernel
def select_pairs(optical_depth, t, dt, offsets, min_weight, max_distance, weight_fraction, counts):
    """Says which samples join the one before, and counts what remains of each ray [R].

    Args:
        faint, apart: see `nerf_lightning.kernels.merge`.
        share: [N], of the weight of both what the joining one has; -1 for those that do not join.
    """
    for ray in prange(len(offsets) - 1):
        optical, through, before, joins, kept = 0.0, 1.0, 0.0, False, 0
        for n in range(offsets[ray], offsets[ray + 1]):
            optical += optical_depth[n]
            behind = math.exp(-optical)
            weight = through - behind
            both = before + weight
            joins = n > offsets[ray] and not joins and t[n] - t[n - 1] < max_distance * (dt[n] + dt[n - 1])
            joins = joins and min(before, weight) < min_weight and both < 2  # which it is not where one is NaN
            weight_fraction[n] = (weight / both if both > 0 else 0.0) if joins else -1.0
            kept += not joins
            through, before = behind, weight
        counts[ray] = kept


@kernel
def merge_pairs(weight_fraction, offsets, kept_offsets, optical_depth, t, dt, out, out_ray):
    """Packs what remains: its thickness, t and dt into out [3, K]."""
    for ray in prange(len(offsets) - 1):
        to = kept_offsets[ray] - 1
        for n in range(offsets[ray], offsets[ray + 1]):
            if weight_fraction[n] < 0:
                to += 1
                out[0, to], out[1, to], out[2, to], out_ray[to] = optical_depth[n], t[n], dt[n], ray
            else:
                out[0, to] += optical_depth[n]
                out[1, to] += weight_fraction[n] * (t[n] - t[n - 1])
                out[2, to] += dt[n]
