"""TensoRF's planes times lines and their gradient: whole rows of channels at once at each sample."""

import numpy as np
from numba import float32, prange, uint32

from nerf_lightning.kernels.cpu.compile import inner, kernel
from nerf_lightning.kernels.cpu.hashgrid import cell_of, steepness
from nerf_lightning.kernels.cpu.lanes import load, prefetch, spread, store, total, turn

TILE = 512
"""Samples worked on together where features [C, N] turn into rows [N, C], or back: long runs in memory, still in cache."""
AHEAD = 8
"""Samples by which a plane's rows are asked for in advance: a large one does not fit the core's cache."""


@inner
def room():
    """What `locate` fills for a tile: rows of the plane, fractions in its cells, rows of the line, fractions on it."""
    corners, ends = np.empty(TILE + AHEAD, np.uint32), np.empty(TILE, np.uint32)
    return corners, np.empty((2, TILE), np.float32), ends, np.empty(TILE, np.float32)


@inner
def locate(unit, first, count, mode, cells, at):
    """Where places [3, N] from `first` on lie: fills `room` with the rows of the lower corners on the plane, the last one a few
    times more, and with those of the lower ends on the line along axis `mode`."""
    corners, within, ends, along = at
    across, down = unit[1 if mode == 0 else 0], unit[1 if mode == 2 else 2]
    for k in range(count):
        a, within[0, k] = cell_of(across[first + k], cells)
        b, within[1, k] = cell_of(down[first + k], cells)
        corners[k] = a * uint32(cells + 1) + b
        ends[k], along[k] = cell_of(unit[mode, first + k], cells)
    corners[count : count + AHEAD] = corners[count - 1]


@inner
def give_rows(above, feature, first, count, rows, lanes, block):
    """rows[k, c] = above[feature + c, first + k], or above[0, first + k] where there is but one row that serves all."""
    if len(above) > 1:
        turn(above, feature, first, rows, 0, 0, rows.shape[1], count, block)
    else:
        for k in range(count):
            store(rows, k, 0, spread(above[0, first + k], lanes))


@inner(inline="always")
def fetch(plane, corner, cells, first):
    """Brings the rows of a cell's corners near, without waiting for them."""
    above = corner + uint32(cells + 1)
    prefetch(plane, corner, first)
    prefetch(plane, corner + uint32(1), first)
    prefetch(plane, above, first)
    prefetch(plane, above + uint32(1), first)


@inner(inline="always")
def on_plane(plane, corner, cells, fa, fb, first, lanes):
    """Bilinear interpolation of the channels from `first` on."""
    ga, gb, one = float32(1) - fa, float32(1) - fb, uint32(1)
    above = corner + uint32(cells + 1)
    near = ga * gb * load(plane, corner, first, lanes) + ga * fb * load(plane, corner + one, first, lanes)
    return near + (fa * gb * load(plane, above, first, lanes) + fa * fb * load(plane, above + one, first, lanes))


@inner(inline="always")
def on_line(line, place, f, first, lanes):
    """Linear interpolation of the channels from `first` on."""
    return (float32(1) - f) * load(line, place, first, lanes) + f * load(line, place + uint32(1), first, lanes)


@inner(inline="always")
def product(plane, line, k, cells, at, lanes):
    """All channels of a plane times those of the line across it, at place k of a tile; a later one's rows are asked for."""
    corners, within, ends, along = at
    fetch(plane, corners[k + AHEAD], cells, 0)
    value = on_plane(plane, corners[k], cells, within[0, k], within[1, k], 0, lanes)
    return value * on_line(line, ends[k], along[k], 0, lanes)


@kernel
def products(planes, lines, unit, out, lanes, block, workers):
    """out [3 C, N] from planes [3, S S, C], lines [3, S, C] and unit [3, N]. `lanes` is a tuple of length C, `block` one of a
    length that divides it."""
    samples, cells, channels = unit.shape[1], lines.shape[1] - 1, len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        rows, at = np.empty((TILE, len(lanes)), np.float32), room()
        # One mode after the other: its plane then stays in the core's cache.
        for mode in range(3):
            plane, line = planes[mode], lines[mode]
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                locate(unit, first, count, mode, cells, at)
                for k in range(count):
                    store(rows, k, 0, product(plane, line, k, cells, at, lanes))
                turn(rows, 0, 0, out, mode * channels, first, count, channels, block)


@kernel
def sums(planes, lines, unit, out, lanes, workers):
    """out [1, N]: what `products` gives, summed over its features."""
    samples, cells = unit.shape[1], lines.shape[1] - 1
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        out[0, start:end] = float32(0)
        at = room()
        for mode in range(3):
            plane, line = planes[mode], lines[mode]
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                locate(unit, first, count, mode, cells, at)
                for k in range(count):
                    out[0, first + k] += total(product(plane, line, k, cells, at, lanes))


@inner(inline="always")
def add_to(rows, row, first, values, lanes):
    store(rows, row, first, load(rows, row, first, lanes) + values)


@inner
def scatter_block(plane, line, grad_plane, grad_line, unit, above, feature, mode, channel, lanes, block):
    """Adds the gradient of one mode's channels from `channel` on, which are the features from `feature` on."""
    samples, cells, one = unit.shape[1], len(line) - 1, uint32(1)
    rows, at = np.empty((TILE, len(lanes)), np.float32), room()
    corners, within, ends, along = at
    for first in range(0, samples, TILE):
        count = min(TILE, samples - first)
        locate(unit, first, count, mode, cells, at)
        give_rows(above, feature, first, count, rows, lanes, block)
        for k in range(count):
            fetch(plane, corners[k + AHEAD], cells, channel)
            fetch(grad_plane, corners[k + AHEAD], cells, channel)
            corner, fa, fb, place, fc = corners[k], within[0, k], within[1, k], ends[k], along[k]
            ga, gb, next_row = float32(1) - fa, float32(1) - fb, corner + uint32(cells + 1)
            given = load(rows, k, 0, lanes)
            to_line = given * on_plane(plane, corner, cells, fa, fb, channel, lanes)
            to_plane = given * on_line(line, place, fc, channel, lanes)
            add_to(grad_line, place, channel, (float32(1) - fc) * to_line, lanes)
            add_to(grad_line, place + one, channel, fc * to_line, lanes)
            add_to(grad_plane, corner, channel, ga * gb * to_plane, lanes)
            add_to(grad_plane, corner + one, channel, ga * fb * to_plane, lanes)
            add_to(grad_plane, next_row, channel, fa * gb * to_plane, lanes)
            add_to(grad_plane, next_row + one, channel, fa * fb * to_plane, lanes)


@kernel
def scatter(planes, lines, unit, above, grad_planes, grad_lines, block, pair, workers):
    """Adds to the gradients. A mode's block of channels, as many as `block`, belongs to one worker, so no two share a place.

    Args:
        above: [3 C, N], or one row that serves all features.
        pair: a tuple of twice the length of `block`: two blocks that a worker has of one mode are added together.
    """
    channels = planes.shape[2]
    blocks = channels // len(block)
    for worker in prange(workers):
        # Neighbouring blocks go to one worker: two workers on one plane would fight over cache lines.
        index, end = 3 * blocks * worker // workers, 3 * blocks * (worker + 1) // workers
        while index < end:
            mode, channel, feature = index // blocks, index % blocks * len(block), index * len(block)
            plane, line, to_plane, to_line = planes[mode], lines[mode], grad_planes[mode], grad_lines[mode]
            if blocks % 2 == 0 and index % 2 == 0 and index + 1 < end:
                scatter_block(plane, line, to_plane, to_line, unit, above, feature, mode, channel, pair, block)
                index += 2
            else:
                scatter_block(plane, line, to_plane, to_line, unit, above, feature, mode, channel, block, block)
                index += 1


@inner(inline="always")
def slopes_on_plane(plane, corner, cells, fa, fb, lanes):
    """How all channels change per cell along the plane's first axis, and along its second."""
    ga, gb, one, less = float32(1) - fa, float32(1) - fb, uint32(1), float32(-1)
    above = corner + uint32(cells + 1)
    a, b = load(plane, corner, 0, lanes), load(plane, corner + one, 0, lanes)
    c, d = load(plane, above, 0, lanes), load(plane, above + one, 0, lanes)
    return gb * (c + less * a) + fb * (d + less * b), ga * (b + less * a) + fa * (d + less * c)


@kernel
def slope(planes, lines, unit, above, grad, lanes, block, workers):
    """Fills grad [3, N], the gradient in the places; `above` as in `scatter`, `lanes` and `block` as in `products`."""
    samples, cells, channels = unit.shape[1], lines.shape[1] - 1, len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        rows, at = np.empty((TILE, len(lanes)), np.float32), room()
        corners, within, ends, along = at
        grad[:, start:end] = float32(0)
        for mode in range(3):
            plane, line, one = planes[mode], lines[mode], uint32(1)
            first_axis, second_axis = 1 if mode == 0 else 0, 1 if mode == 2 else 2
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                locate(unit, first, count, mode, cells, at)
                give_rows(above, mode * channels, first, count, rows, lanes, block)
                for k in range(count):
                    fetch(plane, corners[k + AHEAD], cells, 0)
                    n, corner, fa, fb, place = first + k, corners[k], within[0, k], within[1, k], ends[k]
                    given = load(rows, k, 0, lanes)
                    to_plane = given * on_line(line, place, along[k], 0, lanes)
                    change = load(line, place + one, 0, lanes) + float32(-1) * load(line, place, 0, lanes)
                    to_line = given * on_plane(plane, corner, cells, fa, fb, 0, lanes)
                    da, db = slopes_on_plane(plane, corner, cells, fa, fb, lanes)
                    grad[first_axis, n] += steepness(unit[first_axis, n], cells) * total(to_plane * da)
                    grad[second_axis, n] += steepness(unit[second_axis, n], cells) * total(to_plane * db)
                    grad[mode, n] += steepness(unit[mode, n], cells) * total(to_line * change)
