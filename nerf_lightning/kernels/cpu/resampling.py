"""Inverse transform sampling of intervals along rays in warped distances s."""

from numba import float32, prange

from nerf_lightning.kernels.cpu.jit import jit, kernel
from nerf_lightning.kernels.cpu.march import ray_span, to_unit, unwarp


@jit(forceinline=True)
def distance(s, span, unbounded):
    """`Bounds.s_to_t` of a scalar."""
    first, last, enter, leave, unit, low, length = span
    if not unbounded:
        return first + (last - first) * s
    return unwarp(low + length * s, enter, leave, unit)


@kernel
def interval_midpoints(origins, directions, near, far, inside, s, center, half, unbounded, unit, t, dt):
    """Fills unit [3, R S], t [R, S] and dt [R, S] from s [R, S + 1]."""
    rays, steps = t.shape
    for ray in prange(rays):
        span = ray_span(near, far, inside, ray, half, unbounded)
        start = distance(s[ray, 0], span, unbounded)
        for k in range(steps):
            end, n = distance(s[ray, k + 1], span, unbounded), ray * steps + k
            middle = (start + end) / float32(2)
            x, y = origins[ray, 0] + middle * directions[ray, 0], origins[ray, 1] + middle * directions[ray, 1]
            z = origins[ray, 2] + middle * directions[ray, 2]
            unit[0, n], unit[1, n], unit[2, n] = to_unit(x, y, z, center, half, unbounded)
            t[ray, k], dt[ray, k] = middle, end - start
            start = end


@kernel
def resample(s, pdf, shift, floor, out):
    """Fills out [R, K + 1] from s [R, S + 1] and pdf [R, S]: see `nerf_lightning.kernels.resampling.resample`."""
    rays, steps, count = len(s), pdf.shape[1], out.shape[1] - 1
    for ray in prange(rays):
        total = float32(0)
        for k in range(steps):
            total += pdf[ray, k] + floor
        k, passed = 0, float32(0)
        for j in range(count + 1):
            u = min(max((float32(j) + shift[ray]) / float32(count), float32(0)), float32(1)) * total
            while k < steps - 1 and passed + (pdf[ray, k] + floor) <= u:
                passed += pdf[ray, k] + floor
                k += 1
            part = min(max((u - passed) / (pdf[ray, k] + floor), float32(0)), float32(1))
            out[ray, j] = s[ray, k] + part * (s[ray, k + 1] - s[ray, k])
