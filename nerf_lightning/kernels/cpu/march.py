"""Walking rays through an occupancy grid.

Distances, positions and cells are rounded exactly as the torch reference rounds them, so both keep the same samples.
"""

import numpy as np
from numba import float32, int32, prange, uint8

from nerf_lightning.kernels.cpu.compile import inner, kernel

FAR = 8
"""Most blocks that a leap looks ahead."""
ROUNDED = float32(1e-6)
"""Share by which places and distances may differ from the reference's: some roundings to single precision."""


@inner
def warp(t, enter, leave, unit):
    """Numbers in which an unbounded ray's steps are even; see `nerf_lightning.cameras.bounds.warp`."""
    one, zero = float32(1), float32(0)
    before, behind = max((enter - t) / unit, zero), max((t - leave) / unit, zero)
    within = (min(max(t, enter), leave) - enter) / unit
    return one / (one + before) - one / (one + behind) + within


@inner
def unwarp(y, enter, leave, unit):
    """The inverse of `warp`."""
    one, zero, most = float32(1), float32(0), float32(1 - 1e-6)
    length = (leave - enter) / unit
    if y < zero:
        return enter - unit * (one / (one + max(y, -most)) - one)
    if y > length:
        return leave + unit * (one / (one - min(y - length, most)) - one)
    return enter + unit * y


@inner(forceinline=True)
def span_of(near, far, inside, ray, half, unbounded):
    """What `edge` needs to know of a ray: where it begins and ends, and of an unbounded one its warped distances."""
    first, last, unit = near[ray], max(far[ray], near[ray]), max(half[0], max(half[1], half[2]))
    enter, leave, low, length = float32(0), float32(0), float32(0), float32(0)
    if unbounded:
        enter, leave = inside[ray, 0], inside[ray, 1]
        low = warp(first, enter, leave, unit)
        length = warp(last, enter, leave, unit) - low
    return first, last, enter, leave, unit, low, length


@inner(forceinline=True)
def edge(k, shift, span, step, samples, unbounded):
    """Distance at which interval k begins."""
    first, last, enter, leave, unit, low, length = span
    steps = (float32(k) - float32(0.5)) + shift
    if not unbounded:
        return min(first + max(steps, float32(0)) * step, last)
    return unwarp(low + length * min(max(steps / float32(samples), float32(0)), float32(1)), enter, leave, unit)


@inner
def to_unit(x, y, z, centre, half, unbounded):
    """`Bounds.to_unit` of one position."""
    if not unbounded:
        two = float32(2)
        return (
            (x - (centre[0] - half[0])) / (two * half[0]),
            (y - (centre[1] - half[1])) / (two * half[1]),
            (z - (centre[2] - half[2])) / (two * half[2]),
        )
    a, b, c = (x - centre[0]) / half[0], (y - centre[1]) / half[1], (z - centre[2]) / half[2]
    norm = max(max(abs(a), abs(b)), max(abs(c), float32(1)))
    reach = float32(2) - float32(1) / norm
    quarter, middle = float32(0.25), float32(0.5)
    return (
        reach * (a / norm) * quarter + middle,
        reach * (b / norm) * quarter + middle,
        reach * (c / norm) * quarter + middle,
    )


@inner
def cell(u, resolution):
    return min(max(int32(u * float32(resolution)), int32(0)), int32(resolution - 1))


@inner
def flat_cell(u, v, w, resolution):
    """Number of the cell of a cubic grid that holds a place in the unit cube."""
    return (cell(u, resolution) * resolution + cell(v, resolution)) * resolution + cell(w, resolution)


@inner(inline="always")
def crossing(origin, direction, middle, half, cells):
    """Of a ray along one axis: where it starts, in cells of a grid over the box, how far it goes for one of them, and how far
    while rounding may leave open which one it is in."""
    scale = float32(cells) / (float32(2) * half)
    speed = direction * scale
    start, a_cell = (origin - (middle - half)) * scale, (float32(1) / speed if speed != float32(0) else float32(1e30))
    return start, a_cell, ROUNDED * (abs(start) + float32(cells)) * abs(a_cell)


@inner(inline="always")
def when_at_wall(u, cells, clear, axis):
    """Distance up to which a ray is surely in cells nearer than the `clear`-th from that at u along an axis; see `crossing`."""
    start, a_cell, unsure = axis
    wall = cell(u, cells) + (clear if a_cell > float32(0) else 1 - clear)
    return (float32(wall) - start) * a_cell - unsure


@kernel
def walk(which, origins, directions, near, far, inside, shift, occupied, resolution, blocks, cells, centre, half, unbounded,
         samples, step, most, after, found, counts):  # fmt: skip
    """Writes the next intervals to keep of some rays [A] into found [A, most], and how many into counts [A].

    Args:
        which: [A], the rays.
        occupied: [resolution^3], row by row.
        blocks: [cells^3], from `clear`: empty ones are crossed in leaps.
        after: [R], where each ray goes on: at this interval. Moved on.
    """
    for n in prange(len(which)):
        ray = which[n]
        span, k, kept = span_of(near, far, inside, ray, half, unbounded), int(after[ray]), 0
        across = crossing(origins[ray, 0], directions[ray, 0], centre[0], half[0], cells)
        down = crossing(origins[ray, 1], directions[ray, 1], centre[1], half[1], cells)
        deep = crossing(origins[ray, 2], directions[ray, 2], centre[2], half[2], cells)
        unsure = float32(0.01) + ROUNDED * span[1] / step  # steps by which a distance may be wrong
        start = edge(k, shift[ray], span, step, samples, unbounded)
        while k <= samples and kept < most:
            end = edge(k + 1, shift[ray], span, step, samples, unbounded)
            if not end > start:
                if start >= span[1]:
                    break
                k, start = k + 1, end
                continue
            t = (start + end) / float32(2)
            x, y = origins[ray, 0] + t * directions[ray, 0], origins[ray, 1] + t * directions[ray, 1]
            u, v, w = to_unit(x, y, origins[ray, 2] + t * directions[ray, 2], centre, half, unbounded)
            clear = int(blocks[flat_cell(u, v, w, cells)])
            if clear > 0:
                if not unbounded:
                    first = min(when_at_wall(u, cells, clear, across), when_at_wall(v, cells, clear, down))
                    first = min(first, when_at_wall(w, cells, clear, deep))
                    leap = int((first - t) / step - unsure)
                    if leap > 0:
                        k += leap
                        end = edge(k + 1, shift[ray], span, step, samples, unbounded)
            elif occupied[flat_cell(u, v, w, resolution)]:
                found[n, kept] = k
                kept += 1
            k, start = k + 1, end
        after[ray], counts[n] = k, kept


@kernel
def pack(which, near, far, inside, shift, half, unbounded, samples, step, found, offsets, t, dt, ray_of):
    """Distances and lengths of the intervals that `walk` found, one ray after the other."""
    for n in prange(len(which)):
        ray = which[n]
        span = span_of(near, far, inside, ray, half, unbounded)
        for m in range(offsets[n], offsets[n + 1]):
            k = found[n, m - offsets[n]]
            start = edge(k, shift[ray], span, step, samples, unbounded)
            end = edge(k + 1, shift[ray], span, step, samples, unbounded)
            t[m], dt[m], ray_of[m] = (start + end) / float32(2), end - start, ray


@kernel
def clear(blocks):
    """Turns 0 and `FAR` in blocks [n, n, n] into how many blocks away the nearest 0 is, over corners too, at most `FAR`."""
    n, between = len(blocks), np.empty_like(blocks)
    for i in prange(n):
        for j in range(n):
            row = blocks[i, j]
            for k in range(1, n):
                row[k] = min(row[k], uint8(row[k - 1] + uint8(1)))
            for k in range(n - 2, -1, -1):
                row[k] = min(row[k], uint8(row[k + 1] + uint8(1)))
        for j in range(n):
            nearest_in_rows(blocks[i], j, between[i, j])
    for i in prange(n):
        for j in range(n):
            nearest_in_rows(between[:, j], i, blocks[i, j])


@inner
def nearest_in_rows(rows, here, out):
    """out [n]: the least, over the rows around `here`, of what they hold, or how far away they are if that is more."""
    out[:] = rows[here]
    for other in range(max(here - FAR + 1, 0), min(here + FAR, len(rows))):
        away, row = uint8(abs(other - here)), rows[other]
        for k in range(len(out)):
            out[k] = min(out[k], max(away, row[k]))


@kernel
def points(origins, directions, ray, t, out):
    """out [3, N] = origins[ray] + t * directions[ray]."""
    for n in prange(len(t)):
        r = ray[n]
        for axis in range(3):
            out[axis, n] = origins[r, axis] + t[n] * directions[r, axis]


@kernel
def mark(places, centre, half, unbounded, marks, resolution, value):
    """Writes a value into the cells that hold places [3, N]. Two workers may write to one cell: the same value."""
    for n in prange(places.shape[1]):
        u, v, w = to_unit(places[0, n], places[1, n], places[2, n], centre, half, unbounded)
        marks[flat_cell(u, v, w, resolution)] = value
