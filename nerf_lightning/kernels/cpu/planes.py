"""TensoRF's planes times lines and their gradient: whole rows of channels at once at each sample."""

import numpy as np
from numba import float32, prange, uint32

from nerf_lightning.kernels.cpu.compile import inner, kernel
from nerf_lightning.kernels.cpu.hashgrid import cell_of, steepness
from nerf_lightning.kernels.cpu.lanes import load, store, total

TILE = 512
"""Samples worked on together where features [C, N] turn into rows [N, C], or back: long runs in memory, still in cache."""


@inner(inline="always")
def locate(unit, n, mode, cells):
    """Row of the plane's lower corner and the fractions in it, then row and fraction on the line along axis `mode`."""
    a, fa = cell_of(unit[1 if mode == 0 else 0, n], cells)
    b, fb = cell_of(unit[1 if mode == 2 else 2, n], cells)
    c, fc = cell_of(unit[mode, n], cells)
    return a * uint32(cells + 1) + b, fa, fb, c, fc


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


@kernel
def products(planes, lines, unit, out, lanes, workers):
    """out [3 C, N] from planes [3, S S, C], lines [3, S, C] and unit [3, N]. `lanes` is a tuple of length C."""
    samples, cells, channels = unit.shape[1], lines.shape[1] - 1, len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        rows = np.empty((TILE, len(lanes)), np.float32)
        # One mode after the other: its plane then stays in the core's cache.
        for mode in range(3):
            plane, line = planes[mode], lines[mode]
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                for k in range(count):
                    corner, fa, fb, place, fc = locate(unit, first + k, mode, cells)
                    value = on_plane(plane, corner, cells, fa, fb, 0, lanes) * on_line(line, place, fc, 0, lanes)
                    store(rows, k, 0, value)
                for c in range(channels):
                    for k in range(count):
                        out[mode * channels + c, first + k] = rows[k, c]


@kernel
def sums(planes, lines, unit, out, lanes, workers):
    """out [1, N]: what `products` gives, summed over its features."""
    samples, cells = unit.shape[1], lines.shape[1] - 1
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        out[0, start:end] = float32(0)
        for mode in range(3):
            plane, line = planes[mode], lines[mode]
            for n in range(start, end):
                corner, fa, fb, place, fc = locate(unit, n, mode, cells)
                value = on_plane(plane, corner, cells, fa, fb, 0, lanes) * on_line(line, place, fc, 0, lanes)
                out[0, n] += total(value)


@inner(inline="always")
def add_to(rows, row, first, values, lanes):
    store(rows, row, first, load(rows, row, first, lanes) + values)


@inner
def scatter_block(plane, line, grad_plane, grad_line, unit, above, mode, channel, lanes):
    """Adds the gradient of one mode's channels from `channel` on; `above` is [C, N], or one row that serves all channels."""
    samples, cells, one = unit.shape[1], len(line) - 1, uint32(1)
    rows = np.empty((TILE, len(lanes)), np.float32)
    for first in range(0, samples, TILE):
        count = min(TILE, samples - first)
        for c in range(len(lanes)):
            row = above[c if len(above) > 1 else 0]
            for k in range(count):
                rows[k, c] = row[first + k]
        for k in range(count):
            corner, fa, fb, place, fc = locate(unit, first + k, mode, cells)
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
def scatter(planes, lines, unit, above, grad_planes, grad_lines, lanes, workers):
    """Adds to the gradients. A mode's block of channels, as many as `lanes`, belongs to one worker, so no two share a place."""
    channels = planes.shape[2]
    blocks = channels // len(lanes)
    for worker in prange(workers):
        # Neighbouring blocks go to one worker: two workers on one plane would fight over cache lines.
        for index in range(3 * blocks * worker // workers, 3 * blocks * (worker + 1) // workers):
            mode, channel = index // blocks, index % blocks * len(lanes)
            start = mode * channels + channel if len(above) > 1 else 0
            given = above[start : start + len(lanes)]
            scatter_block(
                planes[mode], lines[mode], grad_planes[mode], grad_lines[mode], unit, given, mode, channel, lanes
            )


@inner(inline="always")
def slopes_on_plane(plane, corner, cells, fa, fb, lanes):
    """How all channels change per cell along the plane's first axis, and along its second."""
    ga, gb, one, less = float32(1) - fa, float32(1) - fb, uint32(1), float32(-1)
    above = corner + uint32(cells + 1)
    a, b = load(plane, corner, 0, lanes), load(plane, corner + one, 0, lanes)
    c, d = load(plane, above, 0, lanes), load(plane, above + one, 0, lanes)
    return gb * (c + less * a) + fb * (d + less * b), ga * (b + less * a) + fa * (d + less * c)


@kernel
def slope(planes, lines, unit, above, grad, lanes, workers):
    """Fills grad [3, N], the gradient in the places; `above` as in `scatter`, `lanes` as in `products`."""
    samples, cells, channels = unit.shape[1], lines.shape[1] - 1, len(lanes)
    for worker in prange(workers):
        start, end = samples * worker // workers, samples * (worker + 1) // workers
        rows = np.empty((TILE, len(lanes)), np.float32)
        grad[:, start:end] = float32(0)
        for mode in range(3):
            plane, line, one = planes[mode], lines[mode], uint32(1)
            first_axis, second_axis = 1 if mode == 0 else 0, 1 if mode == 2 else 2
            for first in range(start, end, TILE):
                count = min(TILE, end - first)
                for c in range(channels):
                    row = above[mode * channels + c if len(above) > 1 else 0]
                    for k in range(count):
                        rows[k, c] = row[first + k]
                for k in range(count):
                    n = first + k
                    corner, fa, fb, place, fc = locate(unit, n, mode, cells)
                    given = load(rows, k, 0, lanes)
                    to_plane = given * on_line(line, place, fc, 0, lanes)
                    along = load(line, place + one, 0, lanes) + float32(-1) * load(line, place, 0, lanes)
                    to_line = given * on_plane(plane, corner, cells, fa, fb, 0, lanes)
                    da, db = slopes_on_plane(plane, corner, cells, fa, fb, lanes)
                    grad[first_axis, n] += steepness(unit[first_axis, n], cells) * total(to_plane * da)
                    grad[second_axis, n] += steepness(unit[second_axis, n], cells) * total(to_plane * db)
                    grad[mode, n] += steepness(unit[mode, n], cells) * total(to_line * along)
