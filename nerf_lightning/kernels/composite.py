"""Volume rendering: compositing of samples along rays (NeRF, eq. 3; Max 1995)."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.kernels import cpu, gpu
from nerf_lightning.kernels.backend import has_fast_kernel, has_gpu_kernel
from nerf_lightning.kernels.march import Packed, first_true_indices, offsets_from_counts
from nerf_lightning.kernels.segment_sums import exclusive_sum

CompositedRays = tuple[Float[Tensor, "R 3"], Float[Tensor, "R"], Float[Tensor, "R"]]
"""Weighted sums of color, opacity and distance along each ray."""
PackedSelection = tuple[Float[Tensor, "K"], Float[Tensor, "K"], Int[Tensor, "K"], Int[Tensor, "R_plus_1"]]
"""`Packed` intervals of K samples of N."""
VisibleSamples = tuple[Float[Tensor, "K"], PackedSelection, Bool[Tensor, "R"] | None]
"""Optical depth and intervals of the kept samples and, with a capacity, whether a ray has all: given and kept ones fitted."""


def volume_weights(
    density: Float[Tensor, "N"],
    dt: Float[Tensor, "N"],
    ray: Int[Tensor, "N"],
    offsets: Int[Tensor, "R_plus_1"],
    per_ray: int | None = None,
) -> Float[Tensor, "N"]:
    """Rendering weights w_i = T_i (1 - exp(-sigma_i dt_i)) with transmittance T_i = exp(-sum_{j < i} sigma_j dt_j).

    Args:
        density: sigma, 1 / world unit, not negative.
        dt: interval lengths, world units.
        ray: ray of each sample, ascending.
        offsets: first sample of each ray, then N.
        per_ray: number of samples of each ray, if all have the same.

    Returns:
        Weights in [0, 1]; their sum over a ray is its opacity.
    """
    if per_ray and has_gpu_kernel(density, constants=(dt,)) and gpu.resampling.is_supported(dt.view(-1, per_ray)):
        return gpu.resampling.IntervalWeights.apply(density, dt.view(-1, per_ray), 0.0, 1.0).flatten()
    exponent = -density * dt
    return -torch.exp(exclusive_sum(exponent, ray, offsets)) * torch.expm1(exponent)


def interval_weights(optical_depth: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """Rendering weights from optical depths (density times length), see `volume_weights`."""
    return torch.exp(optical_depth - optical_depth.cumsum(1)) * -torch.expm1(-optical_depth)


def composite_reference(
    density: Tensor, rgb: Tensor, t: Tensor, dt: Tensor, ray: Tensor, offsets: Tensor
) -> CompositedRays:
    """`composite` in plain PyTorch, for every device."""
    weights = volume_weights(density, dt, ray, offsets)
    values = torch.cat([rgb, torch.ones_like(weights)[:, None], t[:, None]], dim=1)
    sums = values.new_zeros(len(offsets) - 1, 5).index_add(0, ray, weights[:, None] * values)
    color, opacity, distance = sums.split([3, 1, 1], dim=1)
    return color, opacity.squeeze(1), distance.squeeze(1)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, density: Tensor, rgb: Tensor, t: Tensor, dt: Tensor, offsets: Tensor) -> CompositedRays:
        rays, density, rgb = len(offsets) - 1, density.contiguous(), rgb.T.contiguous()
        color, opacity, depth = torch.empty(3, rays), torch.empty(rays), torch.empty(rays)
        transmittance = torch.empty(len(t))
        cpu.composite.forward(density, rgb, t, dt, offsets, color, opacity, depth, transmittance)
        ctx.save_for_backward(density, rgb, t, dt, offsets, transmittance)
        return color.T, opacity, depth

    @staticmethod
    def backward(ctx, color: Tensor, opacity: Tensor, depth: Tensor) -> tuple[Tensor | None, ...]:
        density, rgb = (torch.empty_like(x) for x in ctx.saved_tensors[:2])
        cpu.composite.backward(*ctx.saved_tensors, color.T, opacity, depth, density, rgb)
        return density, rgb.T, None, None, None


def composite(
    density: Float[Tensor, "N"],
    rgb: Float[Tensor, "N 3"],
    t: Float[Tensor, "N"],
    dt: Float[Tensor, "N"],
    ray: Int[Tensor, "N"],
    offsets: Int[Tensor, "R_plus_1"],
) -> CompositedRays:
    """Composites color, opacity and distance along each ray by the weights of `volume_weights`.

    Args:
        density, dt, ray, offsets: see `volume_weights`.
        rgb: color of each sample.
        t: distance of each sample along its ray.

    Returns:
        Color without background, opacity in [0, 1], and the sum of distances (not divided by opacity).
    """
    if has_fast_kernel(density, rgb, constants=(t, dt)):
        return _Composite.apply(density, rgb, t, dt, offsets)
    if has_gpu_kernel(density, rgb, constants=(t, dt)):
        return gpu.composite.Composite.apply(density, rgb, t, dt, offsets)
    return composite_reference(density, rgb, t, dt, ray, offsets)


def filter_visible_reference(
    optical_depth: Tensor,
    packed: Packed,
    early_stop_eps: float,
    min_optical_depth: float | Tensor,
    capacity: int | None = None,
    max_dropped: float = math.inf,
) -> VisibleSamples:
    """`filter_visible` in plain PyTorch, for every device."""
    t, dt, ray, offsets = packed
    transparent = optical_depth < min_optical_depth  # NaN stays and propagates
    if max_dropped < math.inf:
        thin = torch.where(transparent, optical_depth, 0.0)
        transparent &= exclusive_sum(thin, ray, offsets) + thin <= max_dropped
    keep = ~((exclusive_sum(optical_depth, ray, offsets) > -math.log(early_stop_eps)) | transparent)
    if capacity is not None:  # drops the padding of an earlier call
        keep = keep & (dt > 0)
    counts = offsets_from_counts(keep)
    if capacity is None:
        index, kept = keep.nonzero()[:, 0], counts.index_select(0, offsets)
        depths, t, dt, ray = (x.index_select(0, index) for x in (optical_depth, t, dt, ray))
        return depths, (t, dt, ray, kept), None
    index, is_real = first_true_indices(capacity, counts)
    kept = counts.index_select(0, offsets.clamp_max(len(keep)))  # a ray may end beyond the earlier call's capacity
    complete = (offsets[1:] <= len(keep)) & (kept[1:] <= capacity)
    depths, t, dt, ray = (x.index_select(0, index) for x in (optical_depth, t, dt, ray))
    return depths * is_real, (t, dt * is_real, ray, kept), complete


def filter_visible(
    optical_depth: Float[Tensor, "N"],
    packed: Packed,
    early_stop_eps: float,
    min_optical_depth: float | Float[Tensor, ""],
    capacity: int | None = None,
    max_dropped: float = math.inf,
) -> VisibleSamples:
    """Drops occluded samples (transmittance below `early_stop_eps`) and transparent ones.

    Args:
        optical_depth: optical depth of each sample, density times length.
        packed: midpoints, lengths, rays and offsets of N samples.
        early_stop_eps: transmittance below which a ray ends, above 0.
        min_optical_depth: optical depth below which a sample is transparent.
        capacity: see `march`.
        max_dropped: maximum total optical depth of a ray's dropped transparent samples; later ones stay.
    """
    t, dt, ray, offsets = packed
    if has_gpu_kernel(optical_depth, constants=(t, dt)):
        return gpu.composite.filter_visible(
            optical_depth, packed, early_stop_eps, min_optical_depth, capacity, max_dropped
        )
    if capacity is not None or not has_fast_kernel(optical_depth, constants=(t, dt)):
        return filter_visible_reference(optical_depth, packed, early_stop_eps, min_optical_depth, capacity, max_dropped)
    keep, counts = torch.empty(len(t), dtype=torch.bool), torch.empty(len(offsets) - 1, dtype=torch.int64)
    limits = early_stop_eps, float(min_optical_depth), max_dropped
    cpu.composite.mark_visible(optical_depth, offsets, *limits, keep, counts)
    kept = offsets_from_counts(counts)
    out, rays = torch.empty(3, int(kept[-1])), torch.empty(int(kept[-1]), dtype=torch.int64)
    cpu.composite.pack_visible(keep, offsets, kept, optical_depth, t, dt, out, rays)
    return out[0], (out[1], out[2], rays, kept), None


def median_depth_reference(density: Tensor, opacity: Tensor, packed: Packed) -> Float[Tensor, "R"]:
    """`median_depth` in plain PyTorch, for every device."""
    t, dt, ray, offsets = packed
    if not len(t):
        return torch.zeros_like(opacity)
    optical_depth = density * dt
    passed = exclusive_sum(optical_depth, ray, offsets)
    target_depth = -torch.log1p(-opacity / 2)
    count_below = torch.nn.functional.pad((passed + optical_depth < target_depth[ray]).cumsum(0), (1, 0))
    first, last = offsets[:-1], offsets[1:] - 1
    # Rounding may leave a sum short: clamp to the last sample. Rays without samples read any, and get 0 below.
    index = torch.minimum(first + count_below[offsets[1:]] - count_below[first], last).clamp_min(0)
    fraction = ((target_depth - passed[index]) / optical_depth[index].clamp_min(1e-12)).clamp(0, 1)
    return torch.where(opacity > 0, t[index] + (fraction - 0.5) * dt[index], 0.0)


def median_depth(density: Float[Tensor, "N"], opacity: Float[Tensor, "R"], packed: Packed) -> Float[Tensor, "R"]:
    """Median depth, world units: where each ray reaches half its opacity; 0 for transparent rays.

    Exact for density (1 / world unit) constant within an interval: the optical depth there is -log(1 - opacity / 2).
    """
    t, dt, _, offsets = packed
    if not has_fast_kernel(constants=(density, opacity, t, dt)):
        return median_depth_reference(density, opacity, packed)
    depth = torch.empty(len(opacity))
    cpu.composite.find_median_depth(density, opacity, t, dt, offsets, depth)
    return depth
