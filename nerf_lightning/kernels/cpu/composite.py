"""Compositing along rays and its gradient; visibility filtering and early termination."""

import math

from numba import prange

from nerf_lightning.kernels.cpu.jit import kernel


@kernel
def forward(density, rgb, t, dt, offsets, color, opacity, depth, transmittance):
    """Fills color [3, R], opacity [R], depth [R], and the transmittance before each sample [N]."""
    for ray in prange(len(offsets) - 1):
        through = 1.0  # float64: sums over a ray exceed float32 precision
        red, green, blue, alpha, distance = 0.0, 0.0, 0.0, 0.0, 0.0
        for n in range(offsets[ray], offsets[ray + 1]):
            weight = through * -math.expm1(-density[n] * dt[n])
            transmittance[n] = through
            through -= weight
            red += weight * rgb[0, n]
            green += weight * rgb[1, n]
            blue += weight * rgb[2, n]
            alpha += weight
            distance += weight * t[n]
        color[0, ray], color[1, ray], color[2, ray] = red, green, blue
        opacity[ray], depth[ray] = alpha, distance


@kernel
def backward(density, rgb, t, dt, offsets, transmittance, grad_color, grad_opacity, grad_depth, grad_density, grad_rgb):
    """Gradients of density [N] and rgb [3, N] from those of color [3, R], opacity [R] and depth [R].

    With g_i the gradient of weight w_i:  d/d density_i = dt_i (T_{i+1} g_i - sum_{j > i} w_j g_j), computed back to front.
    """
    for ray in prange(len(offsets) - 1):
        red, green, blue = grad_color[0, ray], grad_color[1, ray], grad_color[2, ray]
        behind = 0.0
        for n in range(offsets[ray + 1] - 1, offsets[ray] - 1, -1):
            step = density[n] * dt[n]
            after = transmittance[n] * math.exp(-step)
            weight = transmittance[n] * -math.expm1(-step)
            of_color = red * rgb[0, n] + green * rgb[1, n] + blue * rgb[2, n]
            grad_weight = of_color + grad_opacity[ray] + grad_depth[ray] * t[n]
            grad_density[n] = dt[n] * (after * grad_weight - behind)
            behind += weight * grad_weight
            grad_rgb[0, n], grad_rgb[1, n], grad_rgb[2, n] = weight * red, weight * green, weight * blue


@kernel
def mark_visible(optical_depth, offsets, early_stop_eps, min_optical_depth, max_dropped, keep, counts):
    """Marks visible samples (neither occluded nor transparent), and counts them per ray [R]; see `filter_visible`."""
    max_depth = -math.log(early_stop_eps)
    for ray in prange(len(offsets) - 1):
        optical, thin, kept = 0.0, 0.0, 0
        for n in range(offsets[ray], offsets[ray + 1]):
            step = optical_depth[n]
            is_transparent = step < min_optical_depth  # NaN stays and propagates
            if is_transparent:
                thin += step
            keep[n] = not (optical > max_depth or (is_transparent and thin <= max_dropped))
            kept += keep[n]
            optical += step
        counts[ray] = kept


@kernel
def pack_visible(keep, offsets, kept_offsets, optical_depth, t, dt, out, out_ray):
    """Packs optical depth, t and dt of the kept samples into out [3, K]."""
    for ray in prange(len(offsets) - 1):
        to = kept_offsets[ray]
        for n in range(offsets[ray], offsets[ray + 1]):
            if keep[n]:
                out[0, to], out[1, to], out[2, to], out_ray[to] = optical_depth[n], t[n], dt[n], ray
                to += 1


@kernel
def accumulate_optical_depth(optical_depth, offsets, rays, max_depth, max_intervals, optical, active):
    """Accumulates the optical depth [R] of rays [A] and marks those that continue.

    Args:
        rays: [A], indices of the rays.
        max_depth: optical depth at which a ray ends.
        max_intervals: a ray with fewer new samples has no more.
    """
    for n in prange(len(rays)):
        total = optical[rays[n]]
        for m in range(offsets[n], offsets[n + 1]):
            total += optical_depth[m]
        optical[rays[n]] = total
        active[n] = offsets[n + 1] - offsets[n] == max_intervals and not total > max_depth


@kernel
def append_samples(rays, offsets, optical_depth, t, dt, at, out_optical_depth, out_t, out_dt, out_ray):
    """Appends samples of rays [A] to the packed output at each ray's write position `at` [R], which is advanced."""
    for n in prange(len(rays)):
        ray = rays[n]
        to = at[ray]
        for m in range(offsets[n], offsets[n + 1]):
            out_optical_depth[to], out_t[to], out_dt[to], out_ray[to] = optical_depth[m], t[m], dt[m], ray
            to += 1
        at[ray] = to


@kernel
def find_median_depth(density, opacity, t, dt, offsets, depth):
    """Fills depth [R]: see `nerf_lightning.kernels.composite.median_depth`."""
    for ray in prange(len(offsets) - 1):
        target, passed, last = -math.log1p(-opacity[ray] / 2), 0.0, offsets[ray + 1] - 1
        depth[ray] = 0
        for n in range(offsets[ray], offsets[ray + 1] if opacity[ray] > 0 else 0):
            step = density[n] * dt[n]
            if passed + step >= target or n == last:
                depth[ray] = t[n] + (min(max((target - passed) / max(step, 1e-12), 0.0), 1.0) - 0.5) * dt[n]
                break
            passed += step
