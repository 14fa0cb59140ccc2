"""Where rays cross the occupied cells of a grid over the bounds."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.switch import fast

MAX_CANDIDATES = 1 << 20
"""Intervals the reference looks at together: bounds the memory of one call, whatever the number of rays."""
BLOCK = 4
"""Cells along a side of the blocks that the fast version crosses in one leap where they are empty."""

Packed = tuple[Float[Tensor, "N"], Float[Tensor, "N"], Int[Tensor, "N"], Int[Tensor, "R_plus_1"]]
"""Midpoint and length of each interval, its ray, and where each ray's intervals begin."""


def cell_index(unit: Float[Tensor, "*batch 3"], resolution: int) -> Int[Tensor, "*batch"]:
    """Flat index of the cell of a resolution^3 grid over [0, 1]^3 that holds each position (clamped into the grid)."""
    x, y, z = (unit * resolution).long().clamp_(0, resolution - 1).unbind(-1)
    return torch.add(z, torch.add(y, x, alpha=resolution), alpha=resolution)


def chosen(mask: Bool[Tensor, "M"], room: int | None) -> tuple[Int[Tensor, "K"], Bool[Tensor, "K"] | None]:
    """Which entries of a mask are true, in their order.

    Without `room` the host waits to learn how many there are. With it K = room, and nobody waits: where there are fewer, the
    last one stands again, and the second tensor says which ones count.
    """
    if room is None:
        return mask.nonzero()[:, 0], None
    counted = mask.cumsum(0)
    order, total = torch.arange(1, room + 1, device=mask.device), counted[-1:]
    return torch.searchsorted(counted, torch.minimum(order, total)), order <= total


def ends_of(mask: Bool[Tensor, "R S"]) -> Int[Tensor, "R_plus_1"]:
    """Where each row's entries begin, if the true ones are packed one row after the other, and where the last ends."""
    counts = mask.sum(1)
    return torch.cat([counts.new_zeros(1), counts.cumsum(0)])


def pack_intervals(edges: Float[Tensor, "R S_plus_1"], keep: Bool[Tensor, "R S"], room: int | None = None) -> Packed:
    """Packs the kept intervals between consecutive edges of each ray; for `room` see `march`."""
    flat, there = chosen(keep.flatten(), room)
    ray = flat // keep.shape[1]
    first = flat + ray  # a row of edges is longer by one
    start, end = edges.flatten().index_select(0, first), edges.flatten().index_select(0, first + 1)
    length = end - start if there is None else (end - start) * there
    return (start + end) / 2, length, ray, ends_of(keep)


def march_reference(
    rays: Rays,
    bounds: Bounds,
    near: Float[Tensor, "R"],
    far: Float[Tensor, "R"],
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    room: int | None = None,
) -> Packed:
    """`march` in plain torch, for every device."""
    resolution = round(len(occupied) ** (1 / 3))
    # One more than the steps: the first one may be cut short by the shift, and the last must reach the far end.
    steps = torch.arange(samples + 2, device=near.device) + shift[:, None] - 0.5
    if bounds.unbounded:
        edges = bounds.distances(rays, near, far, (steps / samples).clamp(0, 1))
    else:
        edges = torch.minimum(near[:, None] + steps.clamp_min(0) * step, far[:, None])
    keep = edges[:, 1:] > edges[:, :-1]
    rows = max(1, MAX_CANDIDATES // (samples + 1))
    for start in range(0, len(rays), rows):
        part = slice(start, start + rows)
        t = (edges[part, :-1] + edges[part, 1:]) / 2
        unit = bounds.to_unit(rays.origins[part, None] + t[..., None] * rays.directions[part, None])
        cells = cell_index(unit, resolution)
        keep[part] &= occupied.index_select(0, cells.flatten()).view(cells.shape)
    return pack_intervals(edges, keep, room)


def march(
    rays: Rays,
    bounds: Bounds,
    near: Float[Tensor, "R"],
    far: Float[Tensor, "R"],
    shift: Float[Tensor, "R"],
    occupied: Bool[Tensor, "cells"],
    samples: int,
    step: float,
    room: int | None = None,
) -> Packed:
    """Equal steps from near to far, of which those are kept whose midpoint lies in an occupied cell.

    Args:
        rays, bounds: in world units.
        near, far: distances along each ray; a ray with near >= far gets nothing.
        shift: moves each ray's steps along it, as a share of a step, in [0, 1).
        occupied: cells of a cubic grid over the bounds' unit cube, last axis fastest.
        samples: steps of an unbounded ray, where they are as long as `Bounds.distances` says; otherwise at most so many.
        step: length of a step inside bounds.
        room: entries to make, whatever is found, so that no host waits to learn how much that is. Where less is found, the
            last interval is repeated with length 0; where more is found, rays that end beyond it in `offsets` lack some.
    """
    constants = not any(x.requires_grad for x in (rays.origins, rays.directions, near, far, shift))
    if room is not None or not (constants and fast(rays.origins, near, shift)):
        return march_reference(rays, bounds, near, far, shift, occupied, samples, step, room)
    from nerf_lightning.kernels.cpu import march as cpu
    from nerf_lightning.kernels.cpu import workers

    threads, count, resolution = workers(), len(rays), round(len(occupied) ** (1 / 3))
    cells = resolution // BLOCK if resolution % BLOCK == 0 else resolution
    blocks = np.empty(cells**3, np.bool_)
    cpu.coarsen(occupied.numpy(), resolution, blocks, cells, threads)
    found, counts = np.empty((count, samples + 1), np.int32), np.empty(count, np.int64)
    origins, directions = rays.origins.contiguous().numpy(), rays.directions.contiguous().numpy()
    inside = bounds.inside(rays) if bounds.unbounded else torch.empty(0, 2)
    ends = tuple(x.contiguous().numpy() for x in (near, far, inside, shift))
    half, length = bounds.half_size.numpy(), np.float32(step)
    box = bounds.centre.numpy(), half, bounds.unbounded
    cpu.walk(
        origins, directions, *ends, occupied.numpy(), resolution, blocks, cells, *box, samples, length, found, counts, threads
    )  # fmt: skip
    offsets = torch.zeros(count + 1, dtype=torch.int64)
    np.cumsum(counts, out=offsets.numpy()[1:])
    total = int(offsets[-1])
    t, dt, ray = torch.empty(total), torch.empty(total), torch.empty(total, dtype=torch.int64)
    cpu.pack(
        *ends, half, bounds.unbounded, samples, length, found, offsets.numpy(), t.numpy(), dt.numpy(), ray.numpy(), threads
    )  # fmt: skip
    return t, dt, ray, offsets


def points_reference(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], ray: Int[Tensor, "N"], t: Float[Tensor, "N"]
) -> Float[Tensor, "N 3"]:
    """`points` in plain torch, for every device."""
    return origins.index_select(0, ray) + t[:, None] * directions.index_select(0, ray)


def points(
    origins: Float[Tensor, "R 3"], directions: Float[Tensor, "R 3"], ray: Int[Tensor, "N"], t: Float[Tensor, "N"]
) -> Float[Tensor, "N 3"]:
    """Positions at distances `t` along the rays that `ray` numbers."""
    if not fast(origins, directions, t) or any(x.requires_grad for x in (origins, directions, t)):
        return points_reference(origins, directions, ray, t)
    from nerf_lightning.kernels.cpu import march as cpu
    from nerf_lightning.kernels.cpu import workers

    out = torch.empty(3, len(t))
    arrays = (x.contiguous().numpy() for x in (origins, directions, ray, t))
    cpu.points(*arrays, out.numpy(), workers())
    return out.T


def mark_cells_reference(
    marks: Int[Tensor, "cells"], mark: int, rays: Rays, bounds: Bounds, ray: Int[Tensor, "N"], t: Float[Tensor, "N"]
) -> None:
    """`mark_cells` in plain torch, for every device."""
    unit = bounds.to_unit(points_reference(rays.origins, rays.directions, ray, t))
    marks.index_fill_(0, cell_index(unit, round(len(marks) ** (1 / 3))), mark)


def mark_cells(
    marks: Int[Tensor, "cells"], mark: int, rays: Rays, bounds: Bounds, ray: Int[Tensor, "N"], t: Float[Tensor, "N"]
) -> None:
    """Writes `mark` into each cell of a cubic grid over the bounds that holds one of the samples."""
    if not fast(rays.origins, rays.directions, t):
        return mark_cells_reference(marks, mark, rays, bounds, ray, t)
    from nerf_lightning.kernels.cpu import march as cpu
    from nerf_lightning.kernels.cpu import workers

    arrays = (x.detach().contiguous().numpy() for x in (rays.origins, rays.directions, ray, t))
    box = bounds.centre.numpy(), bounds.half_size.numpy(), bounds.unbounded
    cpu.mark(*arrays, *box, marks.numpy(), round(len(marks) ** (1 / 3)), mark, workers())
