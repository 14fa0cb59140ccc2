"""TensoRF's planes times lines and their gradient, vectorized over the channels of each sample."""

import numpy as np
from numba import float32, prange, uint32

from nerf_lightning.kernels.cpu.hashgrid import cell_of, cells_per_unit
from nerf_lightning.kernels.cpu.jit import jit, kernel
from nerf_lightning.kernels.cpu.simd import broadcast, horizontal_sum, load, prefetch, store, transpose_blocks

TILE = 512
"""Samples transposed together between features [C, N] and rows [N, C]: long runs in memory, still in cache."""
PREFETCH_DISTANCE = 8
"""Samples by which plane rows are prefetched: a large plane does not fit the core's cache."""


@jit
def scratch_buffers():
    """Buffers of `locate_vertices` for a tile: plane rows, fractions in plane cells, line rows, fractions on the line."""
    corners, ends = np.empty(TILE + PREFETCH_DISTANCE, np.uint32), np.empty(TILE, np.uint32)
    return corners, np.empty((2, TILE), np.float32), ends, np.empty(TILE, np.float32)


@jit
def locate_vertices(unit, first, count, mode, cells, at):
    """Locates positions [3, N] from `first` on: fills `scratch_buffers` with the rows of the lower plane corners (padded for
    the prefetch) and of the lower ends on the line along axis `mode`."""
    corners, plane_fractions, ends, line_fractions = at
    across, down = unit[1 if mode == 0 else 0], unit[1 if mode == 2 else 2]
    for k in range(count):
        a, plane_fractions[0, k] = cell_of(across[first + k], cells)
        b, plane_fractions[1, k] = cell_of(down[first + k], cells)
        corners[k] = a * uint32(cells + 1) + b
        ends[k], line_fractions[k] = cell_of(unit[mode, first + k], cells)
    corners[count : count + PREFETCH_DISTANCE] = corners[count - 1]


@jit
def load_grad_rows(grad_output, feature, first, count, rows, lanes, block):
    """Fills rows[k, c] = grad_output[feature + c, first + k], or grad_output[0, first + k] if that is the only row."""
    if len(grad_output) > 1:
        transpose_blocks(grad_output, feature, first, rows, 0, 0, rows.shape[1], count, block)
    else:
        for k in range(count):
            store(rows, k, 0, broadcast(grad_output[0, first + k], lanes))


@jit(inline="always")
def prefetch_corners(plane, corner, cells, first):
    """Prefetches the rows of a cell's corners."""
    next_row = corner + uint32(cells + 1)
    prefetch(plane, corner, first)
    prefetch(plane, corner + uint32(1), first)
    prefetch(plane, next_row, first)
    prefetch(plane, next_row + uint32(1), first)


@jit(inline="always")
def interpolate_plane(plane, corner, cells, fa, fb, first, lanes):
    """Bilinear interpolation of the channels from `first` on."""
    ga, gb, one = float32(1) - fa, float32(1) - fb, uint32(1)
    next_row = corner + uint32(cells + 1)
    near = ga * gb * load(plane, corner, first, lanes) + ga * fb * load(plane, corner + one, first, lanes)
    return near + (fa * gb * load(plane, next_row, first, lanes) + fa * fb * load(plane, next_row + one, first, lanes))


@jit(inline="always")
def interpolate_line(line, line_row, f, first, lanes):
    """Linear interpolation of the channels from `first` on."""
    return (float32(1) - f) * load(line, line_row, first, lanes) + f * load(line, line_row + uint32(1), first, lanes)


@jit(inline="always")
def plane_line_product(plane, line, k, cells, at, lanes):
    """Product of plane and line for all channels at position k of a tile; prefetches a later position's rows."""
    corners, plane_fractions, ends, line_fractions = at
    prefetch_corners(plane, corners[k + PREFETCH_DISTANCE], cells, 0)
    value = interpolate_plane(plane, corners[k], cells, plane_fractions[0, k], plane_fractions[1, k], 0, lanes)
    return value * interpolate_line(line, ends[k], line_fractions[k], 0, lanes)


@kernel
def products(planes, lines, unit, out, lanes, block, workers):
    """Fills out [3 C, N] from planes [3, S S, C], lines [3, S, C] and unit [3, N]; len(lanes) = C, a multiple of len(block)."""
    samples, cells, channels = unit.shape[1], lines.shape[1] - 1, len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        rows, at = np.empty((TILE, len(lanes)), np.float32), scratch_buffers()
        # Mode by mode, so that the plane stays in the core's cache.
        for mode in range(3):
            plane, line = planes[mode], lines[mode]
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                locate_vertices(unit, first, count, mode, cells, at)
                for k in range(count):
                    store(rows, k, 0, plane_line_product(plane, line, k, cells, at, lanes))
                transpose_blocks(rows, 0, 0, out, mode * channels, first, count, channels, block)


@kernel
def sums(planes, lines, unit, out, lanes, workers):
    """Fills out [1, N] with the sum over features of `products`."""
    samples, cells = unit.shape[1], lines.shape[1] - 1
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        out[0, start:end] = float32(0)
        at = scratch_buffers()
        for mode in range(3):
            plane, line = planes[mode], lines[mode]
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                locate_vertices(unit, first, count, mode, cells, at)
                for k in range(count):
                    out[0, first + k] += horizontal_sum(plane_line_product(plane, line, k, cells, at, lanes))


@jit(inline="always")
def add_to_row(rows, row, first, values, lanes):
    store(rows, row, first, load(rows, row, first, lanes) + values)


@jit
def scatter_block(plane, line, grad_plane, grad_line, unit, grad_output, feature, mode, channel, lanes, block):
    """Accumulates the gradient of one mode's channels from `channel` on, which are features from `feature` on."""
    samples, cells, one = unit.shape[1], len(line) - 1, uint32(1)
    rows, at = np.empty((TILE, len(lanes)), np.float32), scratch_buffers()
    corners, plane_fractions, ends, line_fractions = at
    for first in range(0, samples, TILE):
        count = min(TILE, samples - first)
        locate_vertices(unit, first, count, mode, cells, at)
        load_grad_rows(grad_output, feature, first, count, rows, lanes, block)
        for k in range(count):
            prefetch_corners(plane, corners[k + PREFETCH_DISTANCE], cells, channel)
            prefetch_corners(grad_plane, corners[k + PREFETCH_DISTANCE], cells, channel)
            corner, fa, fb = corners[k], plane_fractions[0, k], plane_fractions[1, k]
            line_row, fc = ends[k], line_fractions[k]
            ga, gb, next_row = float32(1) - fa, float32(1) - fb, corner + uint32(cells + 1)
            grad_row = load(rows, k, 0, lanes)
            to_line = grad_row * interpolate_plane(plane, corner, cells, fa, fb, channel, lanes)
            to_plane = grad_row * interpolate_line(line, line_row, fc, channel, lanes)
            add_to_row(grad_line, line_row, channel, (float32(1) - fc) * to_line, lanes)
            add_to_row(grad_line, line_row + one, channel, fc * to_line, lanes)
            add_to_row(grad_plane, corner, channel, ga * gb * to_plane, lanes)
            add_to_row(grad_plane, corner + one, channel, ga * fb * to_plane, lanes)
            add_to_row(grad_plane, next_row, channel, fa * gb * to_plane, lanes)
            add_to_row(grad_plane, next_row + one, channel, fa * fb * to_plane, lanes)


@kernel
def scatter(planes, lines, unit, grad_output, grad_planes, grad_lines, block, pair, workers):
    """Accumulates the gradients. Each block of len(block) channels belongs to one worker, which avoids races.

    Args:
        grad_output: [3 C, N], or one row for all features.
        pair: tuple of twice the length of `block`, to process two blocks of one mode together.
    """
    channels = planes.shape[2]
    blocks = channels // len(block)
    for worker in prange(workers):
        # Adjacent blocks go to one worker, to avoid false sharing of cache lines.
        index, end = 3 * blocks * worker // workers, 3 * blocks * (worker + 1) // workers
        while index < end:
            mode, channel, feature = index // blocks, index % blocks * len(block), index * len(block)
            plane, line, to_plane, to_line = planes[mode], lines[mode], grad_planes[mode], grad_lines[mode]
            if blocks % 2 == 0 and index % 2 == 0 and index + 1 < end:
                scatter_block(plane, line, to_plane, to_line, unit, grad_output, feature, mode, channel, pair, block)
                index += 2
            else:
                scatter_block(plane, line, to_plane, to_line, unit, grad_output, feature, mode, channel, block, block)
                index += 1


@jit(inline="always")
def plane_gradient(plane, corner, cells, fa, fb, lanes):
    """Gradient of bilinear interpolation for all channels along the plane's two axes, per cell."""
    ga, gb, one, less = float32(1) - fa, float32(1) - fb, uint32(1), float32(-1)
    next_row = corner + uint32(cells + 1)
    a, b = load(plane, corner, 0, lanes), load(plane, corner + one, 0, lanes)
    c, d = load(plane, next_row, 0, lanes), load(plane, next_row + one, 0, lanes)
    return gb * (c + less * a) + fb * (d + less * b), ga * (b + less * a) + fa * (d + less * c)


@kernel
def position_gradient(planes, lines, unit, grad_output, grad, lanes, block, workers):
    """Fills grad [3, N], the gradient in the positions; `grad_output` as in `scatter`, `lanes` and `block` as in `products`."""
    samples, cells, channels = unit.shape[1], lines.shape[1] - 1, len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        rows, at = np.empty((TILE, len(lanes)), np.float32), scratch_buffers()
        corners, plane_fractions, ends, line_fractions = at
        grad[:, start:end] = float32(0)
        for mode in range(3):
            plane, line, one = planes[mode], lines[mode], uint32(1)
            first_axis, second_axis = 1 if mode == 0 else 0, 1 if mode == 2 else 2
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                locate_vertices(unit, first, count, mode, cells, at)
                load_grad_rows(grad_output, mode * channels, first, count, rows, lanes, block)
                for k in range(count):
                    prefetch_corners(plane, corners[k + PREFETCH_DISTANCE], cells, 0)
                    n, corner, line_row = first + k, corners[k], ends[k]
                    fa, fb = plane_fractions[0, k], plane_fractions[1, k]
                    grad_row = load(rows, k, 0, lanes)
                    to_plane = grad_row * interpolate_line(line, line_row, line_fractions[k], 0, lanes)
                    change = load(line, line_row + one, 0, lanes) + float32(-1) * load(line, line_row, 0, lanes)
                    to_line = grad_row * interpolate_plane(plane, corner, cells, fa, fb, 0, lanes)
                    da, db = plane_gradient(plane, corner, cells, fa, fb, lanes)
                    grad[first_axis, n] += cells_per_unit(unit[first_axis, n], cells) * horizontal_sum(to_plane * da)
                    grad[second_axis, n] += cells_per_unit(unit[second_axis, n], cells) * horizontal_sum(to_plane * db)
                    grad[mode, n] += cells_per_unit(unit[mode, n], cells) * horizontal_sum(to_line * change)
