"""Ray marching through an occupancy grid, rounded exactly as the torch reference, so that both keep the same samples."""

import numpy as np
from numba import float32, int32, prange, uint8

from nerf_lightning.kernels.cpu.jit import jit, kernel

MAX_BLOCK_DISTANCE = 8
"""Maximum block distance, which bounds a leap."""
ROUNDING_ERROR = float32(1e-6)
"""Bound of the relative rounding error of positions and distances in float32."""


@jit
def warp(t, enter, leave, unit):
    """Warped distance in which an unbounded ray's steps are even; see `nerf_lightning.cameras.bounds.warp`."""
    one, zero = float32(1), float32(0)
    near_distance, far_distance = max((enter - t) / unit, zero), max((t - leave) / unit, zero)
    inside_distance = (min(max(t, enter), leave) - enter) / unit
    return one / (one + near_distance) - one / (one + far_distance) + inside_distance


@jit
def unwarp(y, enter, leave, unit):
    """Inverse of `warp`."""
    one, zero, limit = float32(1), float32(0), float32(1 - 1e-6)
    length = (leave - enter) / unit
    before = enter - unit * (one / (one + max(min(y, zero), -limit)) - one)
    beyond = leave + unit * (one / (one - min(max(y - length, zero), limit)) - one)
    return before if y < zero else (beyond if y > length else enter + unit * y)  # without branches, for vector code


@jit(forceinline=True)
def ray_span(near, far, inside, ray, half, unbounded):
    """Near and far distance of a ray, and for an unbounded one its warped distances, for `interval_start`."""
    first, last, unit = near[ray], max(far[ray], near[ray]), max(half[0], max(half[1], half[2]))
    enter, leave, low, length = float32(0), float32(0), float32(0), float32(0)
    if unbounded:
        enter, leave = inside[ray, 0], inside[ray, 1]
        low = warp(first, enter, leave, unit)
        length = warp(last, enter, leave, unit) - low
    return first, last, enter, leave, unit, low, length


@jit(forceinline=True)
def interval_start(k, shift, span, step, samples, unbounded):
    """Distance at which interval k begins."""
    first, last, enter, leave, unit, low, length = span
    steps = (float32(k) - float32(0.5)) + shift
    if not unbounded:
        return min(first + max(steps, float32(0)) * step, last)
    return unwarp(low + length * min(max(steps / float32(samples), float32(0)), float32(1)), enter, leave, unit)


@jit
def to_unit(x, y, z, center, half, unbounded):
    """`Bounds.to_unit` of one position."""
    if not unbounded:
        two = float32(2)
        return (
            (x - (center[0] - half[0])) / (two * half[0]),
            (y - (center[1] - half[1])) / (two * half[1]),
            (z - (center[2] - half[2])) / (two * half[2]),
        )
    a, b, c = (x - center[0]) / half[0], (y - center[1]) / half[1], (z - center[2]) / half[2]
    norm = max(max(abs(a), abs(b)), max(abs(c), float32(1)))
    scale = float32(2) - float32(1) / norm
    quarter, middle = float32(0.25), float32(0.5)
    return (
        scale * (a / norm) * quarter + middle,
        scale * (b / norm) * quarter + middle,
        scale * (c / norm) * quarter + middle,
    )


@jit
def cell_coordinate(u, resolution):
    return min(max(int32(u * float32(resolution)), int32(0)), int32(resolution - 1))


@jit
def cell_number(u, v, w, resolution):
    """Flat index of the cell of a cubic grid at a position in the unit cube."""
    i, j, k = cell_coordinate(u, resolution), cell_coordinate(v, resolution), cell_coordinate(w, resolution)
    return (i * resolution + j) * resolution + k


@jit(inline="always")
def axis_traversal(origin, direction, middle, half, cells):
    """Traversal of a grid along one axis: start in cells, distance per cell, and rounding tolerance as a distance."""
    scale = float32(cells) / (float32(2) * half)
    speed = direction * scale
    start, per_cell = (origin - (middle - half)) * scale, (float32(1) / speed if speed != float32(0) else float32(1e30))
    return start, per_cell, ROUNDING_ERROR * (abs(start) + float32(cells)) * abs(per_cell)


@jit(inline="always")
def safe_distance(u, cells, empty_blocks, axis):
    """Conservative distance along one axis before the ray leaves the `empty_blocks` known-empty cells around u."""
    start, per_cell, tolerance = axis
    wall = cell_coordinate(u, cells) + (empty_blocks if per_cell > float32(0) else 1 - empty_blocks)
    return (float32(wall) - start) * per_cell - tolerance


@kernel
def march(rays, origins, directions, near, far, inside, shift, occupied, resolution, blocks, cells, center, half, unbounded,
         samples, step, max_intervals, next_interval, intervals, counts):  # fmt: skip
    """Marches rays [A] on: fills intervals [A, max_intervals] with the next occupied intervals and counts [A].

    Args:
        rays: [A], indices of the rays.
        occupied: [resolution^3], row-major.
        blocks: [cells^3], from `compute_block_distances`, to skip empty space.
        next_interval: [R], interval at which each ray continues; advanced.
    """
    for n in prange(len(rays)):
        ray = rays[n]
        span, k, kept = ray_span(near, far, inside, ray, half, unbounded), int(next_interval[ray]), 0
        across = axis_traversal(origins[ray, 0], directions[ray, 0], center[0], half[0], cells)
        down = axis_traversal(origins[ray, 1], directions[ray, 1], center[1], half[1], cells)
        deep = axis_traversal(origins[ray, 2], directions[ray, 2], center[2], half[2], cells)
        tolerance = float32(0.01) + ROUNDING_ERROR * span[1] / step  # in steps
        start = interval_start(k, shift[ray], span, step, samples, unbounded)
        while k <= samples and kept < max_intervals:
            end = interval_start(k + 1, shift[ray], span, step, samples, unbounded)
            if not end > start:
                if start >= span[1]:
                    break
                k, start = k + 1, end
                continue
            t = (start + end) / float32(2)
            x, y = origins[ray, 0] + t * directions[ray, 0], origins[ray, 1] + t * directions[ray, 1]
            u, v, w = to_unit(x, y, origins[ray, 2] + t * directions[ray, 2], center, half, unbounded)
            empty_blocks = int(blocks[cell_number(u, v, w, cells)])
            if empty_blocks > 0:
                if not unbounded:
                    first = safe_distance(u, cells, empty_blocks, across)
                    first = min(first, safe_distance(v, cells, empty_blocks, down))
                    first = min(first, safe_distance(w, cells, empty_blocks, deep))
                    leap = int((first - t) / step - tolerance)
                    if leap > 0:
                        k += leap
                        end = interval_start(k + 1, shift[ray], span, step, samples, unbounded)
            elif occupied[cell_number(u, v, w, resolution)]:
                intervals[n, kept] = k
                kept += 1
            k, start = k + 1, end
        next_interval[ray], counts[n] = k, kept


@kernel
def pack_steps(rays, near, far, inside, shift, half, unbounded, samples, step, intervals, offsets, t, dt, ray_of):
    """Fills midpoint distance, length and ray of the intervals of `march`, packed by ray."""
    for n in prange(len(rays)):
        ray = rays[n]
        span = ray_span(near, far, inside, ray, half, unbounded)
        for m in range(offsets[n], offsets[n + 1]):
            k = intervals[n, m - offsets[n]]
            start = interval_start(k, shift[ray], span, step, samples, unbounded)
            end = interval_start(k + 1, shift[ray], span, step, samples, unbounded)
            t[m], dt[m], ray_of[m] = (start + end) / float32(2), end - start, ray


@kernel
def compute_block_distances(blocks):
    """Replaces blocks [n, n, n] by Chebyshev distances to the nearest 0, at most `MAX_BLOCK_DISTANCE`."""
    n, partial = len(blocks), np.empty_like(blocks)
    for i in prange(n):
        for j in range(n):
            row = blocks[i, j]
            for k in range(1, n):
                row[k] = min(row[k], uint8(row[k - 1] + uint8(1)))
            for k in range(n - 2, -1, -1):
                row[k] = min(row[k], uint8(row[k + 1] + uint8(1)))
        for j in range(n):
            min_distance_over_rows(blocks[i], j, partial[i, j])
    for i in prange(n):
        for j in range(n):
            min_distance_over_rows(partial[:, j], i, blocks[i, j])


@jit
def min_distance_over_rows(rows, center, out):
    """Fills out [n] with the minimum over rows near `center` of max(value, distance of the row)."""
    out[:] = rows[center]
    for index in range(max(center - MAX_BLOCK_DISTANCE + 1, 0), min(center + MAX_BLOCK_DISTANCE, len(rows))):
        distance, row = uint8(abs(index - center)), rows[index]
        for k in range(len(out)):
            out[k] = min(out[k], max(distance, row[k]))


@kernel
def ray_positions(origins, directions, ray, t, out):
    """Fills out [3, N] = origins[ray] + t * directions[ray]."""
    for n in prange(len(t)):
        r = ray[n]
        for axis in range(3):
            out[axis, n] = origins[r, axis] + t[n] * directions[r, axis]


@kernel
def mark_cells(positions, center, half, unbounded, marks, resolution, value):
    """Writes `value` into the cells at positions [3, N]. Races are benign: all workers write the same value."""
    for n in prange(positions.shape[1]):
        u, v, w = to_unit(positions[0, n], positions[1, n], positions[2, n], center, half, unbounded)
        marks[cell_number(u, v, w, resolution)] = value
