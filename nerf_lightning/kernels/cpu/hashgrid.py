"""Hash-grid interpolation and its gradient, a level after the other: one level's table fits a core's cache."""

import numpy as np
from numba import float32, int32, prange, uint32

from nerf_lightning.kernels.cpu.compile import inner, kernel

PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)  # Instant-NGP, eq. 4


@inner(inline="always")
def cell_of(x, resolution):
    """Lower corner and fraction of one coordinate in [0, 1]; clamped outside. What is not a number stays so, in some cell."""
    scaled = min(max(x, float32(0)), float32(1)) * float32(resolution)
    cell = int32(min(uint32(int32(scaled)), uint32(resolution - 1)))
    return uint32(cell), scaled - float32(cell)


@inner(inline="always")
def corners(x, y, z, resolution, entries):
    """Entries of the eight corners, the last coordinate fastest; row-major where they fit, else hashed."""
    side = uint32(resolution + 1)
    if np.int64(side) * side * side <= entries:
        x1 = x + uint32(1)
        y0 = y * side
        y1 = y0 + side
        z0 = z * (side * side)
        z1 = z0 + side * side
        return (
            x + y0 + z0, x + y0 + z1, x + y1 + z0, x + y1 + z1,
            x1 + y0 + z0, x1 + y0 + z1, x1 + y1 + z0, x1 + y1 + z1,
        )  # fmt: skip
    mask = uint32(entries - 1)
    x1 = x + uint32(1)
    y0 = y * PRIME_Y
    y1 = y0 + PRIME_Y
    z0 = z * PRIME_Z
    z1 = z0 + PRIME_Z
    return (
        (x ^ y0 ^ z0) & mask, (x ^ y0 ^ z1) & mask, (x ^ y1 ^ z0) & mask, (x ^ y1 ^ z1) & mask,
        (x1 ^ y0 ^ z0) & mask, (x1 ^ y0 ^ z1) & mask, (x1 ^ y1 ^ z0) & mask, (x1 ^ y1 ^ z1) & mask,
    )  # fmt: skip


@inner
def interpolate_level(table, unit, first, last, resolution, out, features):
    """Fills out[:, first:last]. `features` is a tuple as long as an entry, so that its length is known when compiling."""
    entries = len(table)
    for n in range(first, last):
        cx, fx = cell_of(unit[0, n], resolution)
        cy, fy = cell_of(unit[1, n], resolution)
        cz, fz = cell_of(unit[2, n], resolution)
        i0, i1, i2, i3, i4, i5, i6, i7 = corners(cx, cy, cz, resolution, entries)
        gx, gy, gz = float32(1) - fx, float32(1) - fy, float32(1) - fz
        w0, w1, w2, w3 = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
        w4, w5, w6, w7 = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz
        for f in range(len(features)):
            out[f, n] = (
                (w0 * table[i0, f] + w1 * table[i1, f]) + (w2 * table[i2, f] + w3 * table[i3, f])
            ) + ((w4 * table[i4, f] + w5 * table[i5, f]) + (w6 * table[i6, f] + w7 * table[i7, f]))  # fmt: skip


@inner
def scatter_level(grad, unit, resolution, above, features):
    """Adds the gradient of one level's features, `above` [F, N], to the gradient of its table."""
    entries = len(grad)
    for n in range(unit.shape[1]):
        cx, fx = cell_of(unit[0, n], resolution)
        cy, fy = cell_of(unit[1, n], resolution)
        cz, fz = cell_of(unit[2, n], resolution)
        i0, i1, i2, i3, i4, i5, i6, i7 = corners(cx, cy, cz, resolution, entries)
        gx, gy, gz = float32(1) - fx, float32(1) - fy, float32(1) - fz
        w0, w1, w2, w3 = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
        w4, w5, w6, w7 = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz
        for f in range(len(features)):
            g = above[f, n]
            grad[i0, f] += w0 * g
            grad[i1, f] += w1 * g
            grad[i2, f] += w2 * g
            grad[i3, f] += w3 * g
            grad[i4, f] += w4 * g
            grad[i5, f] += w5 * g
            grad[i6, f] += w6 * g
            grad[i7, f] += w7 * g


@kernel
def interpolate(tables, unit, resolutions, sizes, out, features, workers):
    """out [LF, N] from tables [T, F] and unit [3, N]. A level belongs to few workers: its table then stays in their cache."""
    samples, levels, width = unit.shape[1], len(resolutions), len(features)
    parts = max(1, workers // levels)
    for worker in prange(workers):
        start = 0
        for level in range(levels):
            table = tables[start : start + sizes[level]]
            rows = out[level * width : (level + 1) * width]
            for part in range(parts):
                if (level * parts + part) % workers == worker:
                    first, last = samples * part // parts, samples * (part + 1) // parts
                    interpolate_level(table, unit, first, last, resolutions[level], rows, features)
            start += sizes[level]


@kernel
def scatter(grad, unit, resolutions, sizes, above, features, workers):
    """Fills grad [T, F]. A level belongs to one worker, so no two add to the same entry."""
    levels, width = len(resolutions), len(features)
    for worker in prange(workers):
        start = 0
        for level in range(levels):
            if level % workers == worker:
                part = grad[start : start + sizes[level]]
                part[:] = float32(0)
                scatter_level(part, unit, resolutions[level], above[level * width : (level + 1) * width], features)
            start += sizes[level]
