"""Hash-grid interpolation and its gradient in 2D and 3D, level by level: one level's table fits a core's cache.

`axes` and `features` are tuples whose lengths are compile-time constants: dimensions and features per entry.
"""

import numpy as np
from numba import float32, int32, prange, uint32

from nerf_lightning.kernels.cpu.jit import jit, kernel
from nerf_lightning.kernels.cpu.simd import MAX_LANES, interpolate_lanes

LANES, HASHED = (0,) * MAX_LANES, (0,)
PRIME_Y, PRIME_Z = np.uint32(2654435761), np.uint32(805459861)  # Instant-NGP, eq. 4


@jit(inline="always")
def cell_of(x, resolution):
    """Lower vertex and fraction of a coordinate, clamped to [0, 1]. NaN falls in an arbitrary cell with fraction NaN."""
    scaled = min(max(x, float32(0)), float32(1)) * float32(resolution)
    cell = int32(min(uint32(int32(scaled)), uint32(resolution - 1)))
    return uint32(cell), scaled - float32(cell)


@jit(inline="always")
def combine_corners_2d(x, y, side, dense):
    """Partial entry indices of the four corners from two coordinates, the second coordinate fastest."""
    if dense:
        first = x + y * side
        return first, first + side, first + uint32(1), first + side + uint32(1)
    x1, y0 = x + uint32(1), y * PRIME_Y
    y1 = y0 + PRIME_Y
    return x ^ y0, x ^ y1, x1 ^ y0, x1 ^ y1


@jit(forceinline=True)
def corners(unit, n, cells, entries, axes):
    """Entries and weights of the corners around position n, last coordinate fastest; row-major where dense, else hashed."""
    x, fx = cell_of(unit[0, n], cells[0])
    y, fy = cell_of(unit[1, n], cells[1])
    gx, gy, side, mask = float32(1) - fx, float32(1) - fy, uint32(cells[0] + 1), uint32(entries - 1)
    corners_2d = np.int64(side) * np.int64(cells[1] + 1)
    wa, wb, wc, wd = gx * gy, gx * fy, fx * gy, fx * fy
    if len(axes) == 2:
        dense = corners_2d <= entries
        a, b, c, d = combine_corners_2d(x, y, side, dense)
        if dense:
            return (a, b, c, d), (wa, wb, wc, wd)
        return (a & mask, b & mask, c & mask, d & mask), (wa, wb, wc, wd)
    z, fz = cell_of(unit[2, n], cells[2])
    gz = float32(1) - fz
    weights = wa * gz, wa * fz, wb * gz, wb * fz, wc * gz, wc * fz, wd * gz, wd * fz
    dense = corners_2d * np.int64(cells[2] + 1) <= entries
    a, b, c, d = combine_corners_2d(x, y, side, dense)
    if dense:
        z0 = z * uint32(corners_2d)
        z1 = z0 + uint32(corners_2d)
        return (a + z0, a + z1, b + z0, b + z1, c + z0, c + z1, d + z0, d + z1), weights
    z0 = z * PRIME_Z
    z1 = z0 + PRIME_Z
    return (
        (a ^ z0) & mask, (a ^ z1) & mask, (b ^ z0) & mask, (b ^ z1) & mask,
        (c ^ z0) & mask, (c ^ z1) & mask, (d ^ z0) & mask, (d ^ z1) & mask,
    ), weights  # fmt: skip


@jit(forceinline=True)
def cells_of(resolutions, level, axes):
    """A level's cells along each axis, as scalars that stay in registers."""
    return resolutions[level, 0], resolutions[level, 1], resolutions[level, len(axes) - 1]


@jit
def interpolate_blocks(table, unit, first, last, cells, factors, out, features, hashed):
    """Fills whole vectors of out[:, first:last]; returns the first of the columns that remain."""
    mask = int32(len(table) - 1)
    while first + len(LANES) <= last:
        interpolate_lanes(table, unit, first, cells, factors, mask, out, features, hashed, LANES)
        first += len(LANES)
    return first


@jit
def interpolate_level(table, unit, first, last, cells, out, axes, features):
    """Fills out[:, first:last]."""
    if len(axes) == 3:
        side, area = cells[0] + 1, np.int64(cells[0] + 1) * np.int64(cells[1] + 1)
        if area * np.int64(cells[2] + 1) <= len(table):
            factors = int32(1), int32(side), int32(area)
            first = interpolate_blocks(table, unit, first, last, cells, factors, out, features, ())
        else:
            factors = int32(1), int32(PRIME_Y), int32(PRIME_Z)
            first = interpolate_blocks(table, unit, first, last, cells, factors, out, features, HASHED)
    for n in range(first, last):
        i, w = corners(unit, n, cells, len(table), axes)
        for f in range(len(features)):
            value = (w[0] * table[i[0], f] + w[1] * table[i[1], f]) + (w[2] * table[i[2], f] + w[3] * table[i[3], f])
            if len(axes) == 3:
                upper = w[4] * table[i[4], f] + w[5] * table[i[5], f]
                value += upper + (w[6] * table[i[6], f] + w[7] * table[i[7], f])
            out[f, n] = value


@jit
def scatter_level(grad, unit, cells, grad_output, axes, features):
    """Accumulates the gradient of a level's table from `grad_output` [F, N]."""
    for n in range(unit.shape[1]):
        i, w = corners(unit, n, cells, len(grad), axes)
        for f in range(len(features)):
            g = grad_output[f, n]
            for corner in range(len(w)):
                grad[i[corner], f] += w[corner] * g


@jit(inline="always")
def dot_grad_output(table, row, grad_output, n, features):
    """Gradient in the weight of an entry at position n."""
    value = float32(0)
    for f in range(len(features)):
        value += grad_output[f, n] * table[row, f]
    return value


@jit(inline="always")
def cells_per_unit(x, resolution):
    """Derivative of the grid coordinate; 0 where it is clamped."""
    return float32(resolution) if float32(0) <= x <= float32(1) else float32(0)


@jit(inline="always")
def trilinear_gradient(v, fx, fy, fz):
    """Gradient of trilinear interpolation of corner values along each axis, per cell."""
    gx, gy, gz = float32(1) - fx, float32(1) - fy, float32(1) - fz
    return (
        gy * (gz * (v[4] - v[0]) + fz * (v[5] - v[1])) + fy * (gz * (v[6] - v[2]) + fz * (v[7] - v[3])),
        gx * (gz * (v[2] - v[0]) + fz * (v[3] - v[1])) + fx * (gz * (v[6] - v[4]) + fz * (v[7] - v[5])),
        gx * (gy * (v[1] - v[0]) + fy * (v[3] - v[2])) + fx * (gy * (v[5] - v[4]) + fy * (v[7] - v[6])),
    )


@jit
def position_gradient_level(table, unit, first, last, cells, grad_output, grad, axes, features):
    """Accumulates in grad[:, first:last] the gradient in the positions from a level's `grad_output` [F, N]."""
    for n in range(first, last):
        i, w = corners(unit, n, cells, len(table), axes)
        x, fx = cell_of(unit[0, n], cells[0])
        y, fy = cell_of(unit[1, n], cells[1])
        a = dot_grad_output(table, i[0], grad_output, n, features)
        b = dot_grad_output(table, i[1], grad_output, n, features)
        c = dot_grad_output(table, i[2], grad_output, n, features)
        d = dot_grad_output(table, i[3], grad_output, n, features)
        if len(axes) == 2:
            gx, gy = float32(1) - fx, float32(1) - fy
            dx, dy = gy * (c - a) + fy * (d - b), gx * (b - a) + fx * (d - c)
        else:
            e = dot_grad_output(table, i[4], grad_output, n, features)
            f = dot_grad_output(table, i[5], grad_output, n, features)
            g = dot_grad_output(table, i[6], grad_output, n, features)
            h = dot_grad_output(table, i[7], grad_output, n, features)
            z, fz = cell_of(unit[2, n], cells[2])
            dx, dy, dz = trilinear_gradient((a, b, c, d, e, f, g, h), fx, fy, fz)
            grad[2, n] += cells_per_unit(unit[2, n], cells[2]) * dz
        grad[0, n] += cells_per_unit(unit[0, n], cells[0]) * dx
        grad[1, n] += cells_per_unit(unit[1, n], cells[1]) * dy


@kernel
def interpolate(tables, unit, resolutions, sizes, out, axes, features, workers):
    """Fills out [LF, N] from tables [T, F], unit [D, N] and resolutions [L, D]. Each worker owns whole levels, so that tables
    stay in its core's cache; remaining levels are split evenly."""
    samples, levels, width = unit.shape[1], len(resolutions), len(features)
    owned = levels - levels % workers
    for worker in prange(workers):
        split_samples = samples * (levels - owned)
        begin, end, start = split_samples * worker // workers, split_samples * (worker + 1) // workers, 0
        for level in range(levels):
            passed = samples * (level - owned)
            first, last = max(begin - passed, 0), min(end - passed, samples)
            if level < owned:
                first, last = 0, samples if level % workers == worker else 0
            if first < last:
                table, cells = tables[start : start + sizes[level]], cells_of(resolutions, level, axes)
                rows = out[level * width : (level + 1) * width]
                interpolate_level(table, unit, first, last, cells, rows, axes, features)
            start += sizes[level]


@kernel
def scatter(grad, unit, resolutions, sizes, grad_output, axes, features, workers):
    """Fills grad [T, F]. Each level belongs to one worker, which avoids races."""
    levels, width = len(resolutions), len(features)
    for worker in prange(workers):
        start = 0
        for level in range(levels):
            if level % workers == worker:
                part, cells = grad[start : start + sizes[level]], cells_of(resolutions, level, axes)
                part[:] = float32(0)
                scatter_level(part, unit, cells, grad_output[level * width : (level + 1) * width], axes, features)
            start += sizes[level]


@kernel
def position_gradient(tables, unit, resolutions, sizes, grad_output, grad, axes, features, workers):
    """Fills grad [D, N], the gradient in the positions."""
    samples, width = unit.shape[1], len(features)
    for worker in prange(workers):
        first, last, start = samples * worker // workers, samples * (worker + 1) // workers, 0
        grad[:, first:last] = float32(0)
        for level in range(len(resolutions)):
            table, cells = tables[start : start + sizes[level]], cells_of(resolutions, level, axes)
            rows = grad_output[level * width : (level + 1) * width]
            position_gradient_level(table, unit, first, last, cells, rows, grad, axes, features)
            start += sizes[level]
