"""Walking rays through an occupancy grid.

Distances, positions and cells are rounded exactly as the torch reference rounds them, so both keep the same samples.
"""

from numba import float32, int32, prange

from nerf_lightning.kernels.cpu.compile import inner, kernel


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


@inner
def steps_to_leave(origin, direction, centre, half, cells, u, v, w, t, step):
    """How many steps certainly stay within the current cell of a cells^3 grid over the box (0 if unsure)."""
    nearest = float32(1e30)
    for axis in range(3):
        here = u if axis == 0 else (v if axis == 1 else w)
        d = direction[axis]
        if d == float32(0):
            continue
        low = float32(cell(here, cells))
        wall = (low + (float32(1) if d > 0 else float32(0))) / float32(cells)
        at = ((wall - float32(0.5)) * float32(2) * half[axis] + centre[axis] - origin[axis]) / d
        nearest = min(nearest, at)
    return max(int((nearest - t) / step) - 1, 0)


@kernel
def walk(origins, directions, near, far, inside, shift, occupied, resolution, blocks, cells, centre, half, unbounded, samples,
         step, found, counts, workers):  # fmt: skip
    """Writes which intervals of each ray to keep into found [R, samples + 1], and how many into counts [R].

    Args:
        occupied: [resolution^3], row by row.
        blocks: [cells^3], whether any cell of a block is occupied: empty blocks are crossed in one leap.
    """
    rays = len(near)
    for worker in prange(workers):
        for ray in range(rays * worker // workers, rays * (worker + 1) // workers):
            span, k, kept = span_of(near, far, inside, ray, half, unbounded), 0, 0
            start = edge(0, shift[ray], span, step, samples, unbounded)
            while k <= samples:
                end = edge(k + 1, shift[ray], span, step, samples, unbounded)
                if not end > start:
                    if start >= span[1]:
                        break
                    k, start = k + 1, end
                    continue
                t = (start + end) / float32(2)
                x, y = origins[ray, 0] + t * directions[ray, 0], origins[ray, 1] + t * directions[ray, 1]
                u, v, w = to_unit(x, y, origins[ray, 2] + t * directions[ray, 2], centre, half, unbounded)
                if not blocks[flat_cell(u, v, w, cells)]:
                    leap = 0
                    if not unbounded:
                        leap = steps_to_leave(origins[ray], directions[ray], centre, half, cells, u, v, w, t, step)
                    if leap > 0:
                        k += leap
                        end = edge(k + 1, shift[ray], span, step, samples, unbounded)
                elif occupied[flat_cell(u, v, w, resolution)]:
                    found[ray, kept] = k
                    kept += 1
                k, start = k + 1, end
            counts[ray] = kept


@kernel
def pack(near, far, inside, shift, half, unbounded, samples, step, found, offsets, t, dt, ray_of, workers):
    """Distances and lengths of the intervals that `walk` found, one ray after the other."""
    rays = len(near)
    for worker in prange(workers):
        for ray in range(rays * worker // workers, rays * (worker + 1) // workers):
            span = span_of(near, far, inside, ray, half, unbounded)
            for n in range(offsets[ray], offsets[ray + 1]):
                k = found[ray, n - offsets[ray]]
                start = edge(k, shift[ray], span, step, samples, unbounded)
                end = edge(k + 1, shift[ray], span, step, samples, unbounded)
                t[n], dt[n], ray_of[n] = (start + end) / float32(2), end - start, ray


@kernel
def coarsen(rows, resolution, size, blocks, workers):
    """blocks [cells^3]: whether any of a block's size^3 cells is occupied.

    Args:
        rows: [resolution^2 * cells]: the cells of a block's row as one number, 0 where none is occupied.
    """
    cells = resolution // size
    for worker in prange(workers):
        for i in range(cells * worker // workers, cells * (worker + 1) // workers):
            for j in range(cells):
                block = (i * cells + j) * cells
                blocks[block : block + cells] = False
                for x in range(i * size, (i + 1) * size):
                    for y in range(j * size, (j + 1) * size):
                        row = (x * resolution + y) * cells
                        for k in range(cells):
                            blocks[block + k] |= rows[row + k] != 0


@kernel
def points(origins, directions, ray, t, out, workers):
    """out [3, N] = origins[ray] + t * directions[ray]."""
    samples = len(t)
    for worker in prange(workers):
        for n in range(samples * worker // workers, samples * (worker + 1) // workers):
            r = ray[n]
            for axis in range(3):
                out[axis, n] = origins[r, axis] + t[n] * directions[r, axis]


@kernel
def mark(places, centre, half, unbounded, marks, resolution, value, workers):
    """Writes a value into the cells that hold places [3, N]. Two workers may write to one cell: the same value."""
    samples = places.shape[1]
    for worker in prange(workers):
        for n in range(samples * worker // workers, samples * (worker + 1) // workers):
            u, v, w = to_unit(places[0, n], places[1, n], places[2, n], centre, half, unbounded)
            marks[flat_cell(u, v, w, resolution)] = value
