"""Trilinear interpolation on a sparse voxel grid and its gradient.

For gradients each worker owns a run of rows: it visits all samples in order and adds to these rows only, so that the sums
do not depend on the number of workers. Row 0, of pruned vertices, is constant.
"""

import numpy as np
from numba import float32, int64, prange

from nerf_lightning.kernels.cpu.hashgrid import cell_of, cells_per_unit, trilinear_gradient
from nerf_lightning.kernels.cpu.jit import jit, kernel
from nerf_lightning.kernels.cpu.simd import horizontal_sum, load, store, transpose_blocks

TILE = 64
"""Samples whose basis functions are transposed together."""
SQUARE = (0,) * 8
"""Tuple with the length of a square's side in that transposition."""
BINS = 256
"""Histogram bins of the table's rows for load balancing."""


@jit
def corners(unit, n, index, cells):
    """Rows and weights of the eight vertices around sample n, last coordinate fastest."""
    side = int64(cells + 1)
    i, fx = cell_of(unit[0, n], cells)
    j, fy = cell_of(unit[1, n], cells)
    k, fz = cell_of(unit[2, n], cells)
    gx, gy, gz = float32(1) - fx, float32(1) - fy, float32(1) - fz
    a = (int64(i) * side + int64(j)) * side + int64(k)
    b, c, d = a + side, a + side * side, a + side * side + side
    rows = index[a], index[a + 1], index[b], index[b + 1], index[c], index[c + 1], index[d], index[d + 1]
    low = gx * gy * gz, gx * gy * fz, gx * fy * gz, gx * fy * fz
    return rows, (*low, fx * gy * gz, fx * gy * fz, fx * fy * gz, fx * fy * fz)


@kernel
def locate_vertices(index, cells, unit, rows, weights):
    """Fills rows [N, 8] and weights [N, 8] for unit [3, N]."""
    for n in prange(unit.shape[1]):
        r, w = corners(unit, n, index, cells)
        for c in range(8):
            rows[n, c], weights[n, c] = r[c], w[c]


@kernel
def position_gradient(cells, unit, grad_output, grad):
    """Fills grad [3, N], the gradient in the positions, from that in the weights, `grad_output` [N, 8]."""
    for n in prange(unit.shape[1]):
        x, fx = cell_of(unit[0, n], cells)
        y, fy = cell_of(unit[1, n], cells)
        z, fz = cell_of(unit[2, n], cells)
        dx, dy, dz = trilinear_gradient(grad_output[n], fx, fy, fz)
        grad[0, n] = cells_per_unit(unit[0, n], cells) * dx
        grad[1, n] = cells_per_unit(unit[1, n], cells) * dy
        grad[2, n] = cells_per_unit(unit[2, n], cells) * dz


@kernel
def mark_rows(last_read_step, rows, step):
    """Sets last_read_step [V] = step at rows [N, 8]. Races are benign: all workers write the same value."""
    for n in prange(rows.shape[0]):
        for corner in range(8):
            last_read_step[rows[n, corner]] = step


@kernel
def interpolate(values, index, cells, unit, out):
    """Fills out [N] from values [V] and unit [3, N]."""
    for n in prange(len(out)):
        r, w = corners(unit, n, index, cells)
        low = (w[0] * values[r[0]] + w[1] * values[r[1]]) + (w[2] * values[r[2]] + w[3] * values[r[3]])
        high = (w[4] * values[r[4]] + w[5] * values[r[5]]) + (w[6] * values[r[6]] + w[7] * values[r[7]])
        out[n] = low + high


@kernel
def read(density, color, rows, weights, raw, rgb):
    """Fills raw [N] from density [V], and rgb [3, N] from color [V, 3]."""
    for n in prange(len(raw)):
        s, a, b, c = float32(0), float32(0), float32(0), float32(0)
        for corner in range(8):
            row, weight = rows[n, corner], weights[n, corner]
            s += weight * density[row]
            a += weight * color[row, 0]
            b += weight * color[row, 1]
            c += weight * color[row, 2]
        raw[n], rgb[0, n], rgb[1, n], rgb[2, n] = s, a, b, c


@kernel
def weight_gradient(density, color, rows, raw, rgb, grad):
    """Fills grad [N, 8], the gradient in the weights, from those of raw [N] and rgb [3, N]."""
    for n in prange(len(raw)):
        s, a, b, c = raw[n], rgb[0, n], rgb[1, n], rgb[2, n]
        for corner in range(8):
            row = rows[n, corner]
            grad[n, corner] = s * density[row] + a * color[row, 0] + b * color[row, 1] + c * color[row, 2]


@kernel
def add_sh_color(sh_coefficients, rows, weights, basis, rgb, lanes, workers):
    """Adds to rgb [3, N] the interpolated coefficients [V, 3 B] times basis [B, N]; `lanes` is a tuple of length B."""
    samples, terms = rows.shape[0], len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        tile = np.empty((TILE, terms), np.float32)
        for first in range(start, end, TILE):
            count = min(TILE, end - first)
            transpose_blocks(basis, 0, first, tile, 0, 0, terms, count, SQUARE)
            for k in range(count):
                n = first + k
                row, weight = rows[n, 0], weights[n, 0]
                a = weight * load(sh_coefficients, row, 0, lanes)
                b = weight * load(sh_coefficients, row, terms, lanes)
                c = weight * load(sh_coefficients, row, 2 * terms, lanes)
                for corner in range(1, 8):
                    row, weight = rows[n, corner], weights[n, corner]
                    a = a + weight * load(sh_coefficients, row, 0, lanes)
                    b = b + weight * load(sh_coefficients, row, terms, lanes)
                    c = c + weight * load(sh_coefficients, row, 2 * terms, lanes)
                basis_row = load(tile, k, 0, lanes)
                rgb[0, n] += horizontal_sum(a * basis_row)
                rgb[1, n] += horizontal_sum(b * basis_row)
                rgb[2, n] += horizontal_sum(c * basis_row)


@kernel
def add_sh_weight_gradient(sh_coefficients, rows, basis, rgb, grad, lanes, workers):
    """Adds to grad [N, 8], the gradient in the weights, the part of coefficients [V, 3 B] times basis [B, N]."""
    samples, terms = rows.shape[0], len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        tile = np.empty((TILE, terms), np.float32)
        for first in range(start, end, TILE):
            count = min(TILE, end - first)
            transpose_blocks(basis, 0, first, tile, 0, 0, terms, count, SQUARE)
            for k in range(count):
                n = first + k
                basis_row = load(tile, k, 0, lanes)
                for corner in range(8):
                    row = rows[n, corner]
                    weighted = rgb[0, n] * load(sh_coefficients, row, 0, lanes)
                    weighted = weighted + rgb[1, n] * load(sh_coefficients, row, terms, lanes)
                    weighted = weighted + rgb[2, n] * load(sh_coefficients, row, 2 * terms, lanes)
                    grad[n, corner] += horizontal_sum(weighted * basis_row)


@jit
def balance_rows(rows, table, workers):
    """Row bounds [workers + 1], from 1 to `table`, that balance the load of the workers."""
    counts, width = np.zeros(BINS, np.int64), table // BINS + 1
    for n in range(0, len(rows), 4):  # a subset is enough
        for corner in range(0, 8, 3):
            if rows[n, corner] > 0:
                counts[rows[n, corner] // width] += 1
    bounds = np.full(workers + 1, table)
    bounds[0] = 1
    total, passed, worker = counts.sum(), 0, 1
    for b in range(BINS):
        passed += counts[b]
        while worker < workers and passed * workers >= total * worker:
            bounds[worker] = min((b + 1) * width, table)
            worker += 1
    return bounds


@kernel
def scatter(grad_density, grad_color, rows, weights, raw, rgb, workers):
    """Accumulates the gradients [V] and [V, 3] from those of raw [N] and rgb [3, N]."""
    ends = balance_rows(rows, len(grad_density), workers)
    for worker in prange(workers):
        first, last = ends[worker], ends[worker + 1]
        for n in range(len(rows)):
            s, a, b, c = raw[n], rgb[0, n], rgb[1, n], rgb[2, n]
            for corner in range(8):
                row, weight = rows[n, corner], weights[n, corner]
                if first <= row < last:
                    grad_density[row] += weight * s
                    grad_color[row, 0] += weight * a
                    grad_color[row, 1] += weight * b
                    grad_color[row, 2] += weight * c


@jit
def scatter_sh_rows(grad, rows, weights, basis, rgb, lanes, first, last):
    terms, samples = len(lanes), rows.shape[0]
    tile = np.empty((TILE, terms), np.float32)
    for begin in range(0, samples, TILE):
        count = min(TILE, samples - begin)
        transpose_blocks(basis, 0, begin, tile, 0, 0, terms, count, SQUARE)
        for k in range(count):
            n = begin + k
            basis_row = load(tile, k, 0, lanes)
            a, b, c = rgb[0, n] * basis_row, rgb[1, n] * basis_row, rgb[2, n] * basis_row
            for corner in range(8):
                row, weight = rows[n, corner], weights[n, corner]
                if first <= row < last:
                    store(grad, row, 0, load(grad, row, 0, lanes) + weight * a)
                    store(grad, row, terms, load(grad, row, terms, lanes) + weight * b)
                    store(grad, row, 2 * terms, load(grad, row, 2 * terms, lanes) + weight * c)


@kernel
def scatter_sh(grad, rows, weights, basis, rgb, lanes, workers):
    """Accumulates the gradient [V, 3 B] from that of rgb [3, N]; inlining `scatter_sh_rows` would be a third slower."""
    ends = balance_rows(rows, len(grad), workers)
    for worker in prange(workers):
        scatter_sh_rows(grad, rows, weights, basis, rgb, lanes, ends[worker], ends[worker + 1])


@kernel
def total_variation(values, vertex_of_row, index, side, first, slope, sums, workers):
    """Fills slope with the summed differences to all neighbors of rows of values [V] from `first` on, and sums [workers] with
    their squares."""
    rows = len(slope)
    for worker in prange(workers):
        squares = 0.0
        for n in range(rows * worker // workers, rows * (worker + 1) // workers):
            at, value, difference = int64(vertex_of_row[first + n]), values[first + n], float32(0)
            coords, stride = (at // (side * side), at // side % side, at % side), (side * side, side, 1)
            for axis in range(3):
                for sign in (-1, 1):
                    if 0 <= coords[axis] + sign < side:
                        neighbor = index[at + sign * stride[axis]]
                        if neighbor > 0:
                            d = value - values[neighbor]
                            difference += d
                            squares += d * d
            slope[n] = difference
        sums[worker] = squares
