"""Bilinear interpolation on nested hash grids and its gradient, a level after the other, as `hashgrid` does in 3D."""

import numpy as np
from numba import float32, prange, uint32

from nerf_lightning.kernels.cpu.compile import inner, kernel
from nerf_lightning.kernels.cpu.hashgrid import PRIME_Y, cell_of


@inner(inline="always")
def corners(x, y, across, down, entries):
    """Entries of the four corners, the last coordinate fastest; row-major where they fit, else hashed."""
    side = uint32(across + 1)
    if np.int64(side) * np.int64(down + 1) <= entries:
        first = x + y * side
        return first, first + side, first + uint32(1), first + side + uint32(1)
    mask = uint32(entries - 1)
    x1 = x + uint32(1)
    y0 = y * PRIME_Y
    y1 = y0 + PRIME_Y
    return (x ^ y0) & mask, (x ^ y1) & mask, (x1 ^ y0) & mask, (x1 ^ y1) & mask


@inner
def interpolate_level(table, unit, first, last, across, down, out, features):
    """Fills out[:, first:last]. `features` is a tuple as long as an entry, so that its length is known when compiling."""
    entries = len(table)
    for n in range(first, last):
        cx, fx = cell_of(unit[0, n], across)
        cy, fy = cell_of(unit[1, n], down)
        i0, i1, i2, i3 = corners(cx, cy, across, down, entries)
        gx, gy = float32(1) - fx, float32(1) - fy
        w0, w1, w2, w3 = gx * gy, gx * fy, fx * gy, fx * fy
        for f in range(len(features)):
            out[f, n] = (w0 * table[i0, f] + w1 * table[i1, f]) + (w2 * table[i2, f] + w3 * table[i3, f])


@inner
def scatter_level(grad, unit, across, down, above, features):
    """Adds the gradient of one level's features, `above` [F, N], to the gradient of its table."""
    entries = len(grad)
    for n in range(unit.shape[1]):
        cx, fx = cell_of(unit[0, n], across)
        cy, fy = cell_of(unit[1, n], down)
        i0, i1, i2, i3 = corners(cx, cy, across, down, entries)
        gx, gy = float32(1) - fx, float32(1) - fy
        w0, w1, w2, w3 = gx * gy, gx * fy, fx * gy, fx * fy
        for f in range(len(features)):
            g = above[f, n]
            grad[i0, f] += w0 * g
            grad[i1, f] += w1 * g
            grad[i2, f] += w2 * g
            grad[i3, f] += w3 * g


@kernel
def interpolate(tables, unit, resolutions, sizes, out, features, workers):
    """out [LF, N] from tables [T, F], unit [2, N] and resolutions [L, 2]; each worker takes whole levels."""
    samples, levels, width = unit.shape[1], len(resolutions), len(features)
    parts = max(1, workers // levels)
    for worker in prange(workers):
        start = 0
        for level in range(levels):
            table = tables[start : start + sizes[level]]
            rows = out[level * width : (level + 1) * width]
            across, down = resolutions[level, 0], resolutions[level, 1]
            for part in range(parts):
                if (level * parts + part) % workers == worker:
                    first, last = samples * part // parts, samples * (part + 1) // parts
                    interpolate_level(table, unit, first, last, across, down, rows, features)
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
                rows = above[level * width : (level + 1) * width]
                scatter_level(part, unit, resolutions[level, 0], resolutions[level, 1], rows, features)
            start += sizes[level]
