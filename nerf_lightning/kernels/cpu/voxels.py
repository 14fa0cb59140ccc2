"""Trilinear interpolation on a sparse grid of vertices, and its gradient.

Each sample meets eight vertices; `index` says in which row of the table each one's values stand. In gradients a worker owns
blocks of rows: it visits all samples and adds to its own rows alone. Row 0, of all vertices that are not kept, is constant.
"""

import numpy as np
from numba import float32, int32, int64, prange, uint32

from nerf_lightning.kernels.cpu.compile import inner, kernel

BLOCK = 6
"""Rows are dealt out to workers in blocks of 2^6: wide enough not to share cache lines."""


@inner
def corners(unit, n, index, resolution, rows, weights):
    """Rows and weights of the eight vertices around sample n; outside the unit cube it is clamped."""
    side = resolution + 1
    x = min(max(unit[0, n], float32(0)), float32(1)) * float32(resolution)
    y = min(max(unit[1, n], float32(0)), float32(1)) * float32(resolution)
    z = min(max(unit[2, n], float32(0)), float32(1)) * float32(resolution)
    # As unsigned numbers: what is not a number then lands in the last cell instead of outside the grid.
    top = uint32(resolution - 1)
    i, j, k = min(uint32(int32(x)), top), min(uint32(int32(y)), top), min(uint32(int32(z)), top)
    fx, fy, fz = x - float32(i), y - float32(j), z - float32(k)
    gx, gy, gz = float32(1) - fx, float32(1) - fy, float32(1) - fz
    first = (int64(i) * side + int64(j)) * side + int64(k)
    rows[0], rows[1] = index[first], index[first + 1]
    rows[2], rows[3] = index[first + side], index[first + side + 1]
    first += side * side
    rows[4], rows[5] = index[first], index[first + 1]
    rows[6], rows[7] = index[first + side], index[first + side + 1]
    weights[0], weights[1], weights[2], weights[3] = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
    weights[4], weights[5], weights[6], weights[7] = fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz


@kernel
def interpolate(values, index, resolution, unit, out, workers):
    """out [N] from values [V] and unit [3, N]."""
    samples = len(out)
    for worker in prange(workers):
        rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(samples * worker // workers, samples * (worker + 1) // workers):
            corners(unit, n, index, resolution, rows, weights)
            total = float32(0)
            for c in range(8):
                total += weights[c] * values[rows[c]]
            out[n] = total


@kernel
def scatter(grad, index, resolution, unit, above, workers):
    """Fills grad [V] from above [N]."""
    samples = len(above)
    for worker in prange(workers):
        rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(samples):
            corners(unit, n, index, resolution, rows, weights)
            for c in range(8):
                if rows[c] > 0 and (rows[c] >> BLOCK) % workers == worker:
                    grad[rows[c]] += weights[c] * above[n]


@kernel
def interpolate_colour(values, index, resolution, unit, basis, out, workers):
    """out [3, N]: values [V, 3 B] interpolated, each third of them summed with weights basis [B, N]."""
    samples, terms = unit.shape[1], len(basis)
    for worker in prange(workers):
        rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        mixed = np.empty(3 * terms, np.float32)
        for n in range(samples * worker // workers, samples * (worker + 1) // workers):
            corners(unit, n, index, resolution, rows, weights)
            mixed[:] = float32(0)
            for c in range(8):
                weight, row = weights[c], values[rows[c]]
                for j in range(3 * terms):
                    mixed[j] += weight * row[j]
            for channel in range(3):
                total = float32(0)
                for b in range(terms):
                    total += basis[b, n] * mixed[channel * terms + b]
                out[channel, n] = total


@kernel
def scatter_colour(grad, index, resolution, unit, basis, above, workers):
    """Fills grad [V, 3 B] from above [3, N]."""
    samples, terms = unit.shape[1], len(basis)
    for worker in prange(workers):
        rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        mixed = np.empty(3 * terms, np.float32)
        for n in range(samples):
            corners(unit, n, index, resolution, rows, weights)
            for channel in range(3):
                for b in range(terms):
                    mixed[channel * terms + b] = above[channel, n] * basis[b, n]
            for c in range(8):
                if rows[c] > 0 and (rows[c] >> BLOCK) % workers == worker:
                    weight, row = weights[c], grad[rows[c]]
                    for j in range(3 * terms):
                        row[j] += weight * mixed[j]


@kernel
def touch(touched, index, resolution, unit, workers):
    """Marks the rows that samples read. Workers may meet in a row: they write the same there."""
    samples = unit.shape[1]
    for worker in prange(workers):
        rows, weights = np.empty(8, np.int64), np.empty(8, np.float32)
        for n in range(samples * worker // workers, samples * (worker + 1) // workers):
            corners(unit, n, index, resolution, rows, weights)
            for c in range(8):
                touched[rows[c]] = True
