"""Inverse transform sampling of intervals along rays in warped distances s."""

import numpy as np
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
def interval_midpoints(origins, directions, near, far, inside, s, center, half, unbounded, unit, t, dt, workers):
    """Fills unit [3, R S], t [R, S] and dt [R, S] from s [R, S + 1]. Loops over small arrays become vector code."""
    rays, steps = t.shape
    middle, halves = (center[0], center[1], center[2]), (half[0], half[1], half[2])
    for worker in prange(workers):
        edges, row = np.empty(steps + 1, np.float32), np.empty((5, steps), np.float32)
        for ray in range(rays * worker // workers, rays * (worker + 1) // workers):
            span = ray_span(near, far, inside, ray, half, unbounded)
            x, y, z = origins[ray, 0], origins[ray, 1], origins[ray, 2]
            dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            for k in range(steps + 1):
                edges[k] = distance(s[ray, k], span, unbounded)
            for k in range(steps):
                d = (edges[k] + edges[k + 1]) / float32(2)
                u, v, w = to_unit(x + d * dx, y + d * dy, z + d * dz, middle, halves, unbounded)
                row[0, k], row[1, k], row[2, k], row[3, k], row[4, k] = u, v, w, d, edges[k + 1] - edges[k]
            for k in range(steps):
                n = ray * steps + k
                unit[0, n], unit[1, n], unit[2, n] = row[0, k], row[1, k], row[2, k]
                t[ray, k], dt[ray, k] = row[3, k], row[4, k]


@kernel
def resample(s, pdf, shift, floor, out):
    """Fills out [R, K + 1] from s [R, S + 1] and pdf [R, S]: see `nerf_lightning.kernels.resampling.resample`."""
    rays, steps, count = len(s), pdf.shape[1], out.shape[1] - 1
    for ray in prange(rays):
        total = float32(0)
        for k in range(steps):
            total += pdf[ray, k] + floor
        k, passed, weight = 0, float32(0), pdf[ray, 0] + floor
        for j in range(count + 1):
            u = min(max((float32(j) + shift[ray]) / float32(count), float32(0)), float32(1)) * total
            while k < steps - 1 and passed + weight <= u:
                passed += weight
                k += 1
                weight = pdf[ray, k] + floor
            part = min(max((u - passed) / weight, float32(0)), float32(1))
            out[ray, j] = s[ray, k] + part * (s[ray, k + 1] - s[ray, k])
