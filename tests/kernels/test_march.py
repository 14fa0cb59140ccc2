import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import cell_index, march, use_kernels
from nerf_lightning.kernels.march import Walk
from nerf_lightning.sampler import Samples

CUBE = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))


def marched(
    rays: Rays,
    bounds: Bounds,
    occupied: Tensor,
    samples: int,
    jittered: bool = False,
    step: float | None = None,
    most: int = 1 << 20,
) -> Samples:
    near, far = bounds.near_far(rays)
    shift = torch.zeros_like(near)
    if jittered:
        shift = torch.rand(near.shape, generator=torch.Generator().manual_seed(3))
    step = 2 * float(bounds.half_size.norm()) / samples if step is None else step
    return Samples(*march(rays, bounds, near, far, shift, occupied, samples, step, most=most))


def everywhere(resolution: int) -> Tensor:
    return torch.ones(resolution**3, dtype=torch.bool)


def cell_of(point: list[float], bounds: Bounds, n: int) -> int:
    """The cell of a point in a bounded box, one coordinate at a time."""
    index = 0
    for x, low, high in zip(point, *bounds.aabb.tolist(), strict=True):
        index = index * n + min(max(math.floor((x - low) / (high - low) * n), 0), n - 1)
    return index


def test_cell_index_numbers_cells_row_by_row(box: Bounds):
    positions = box.aabb[0] + torch.rand(300, 3) * (box.aabb[1] - box.aabb[0])
    assert cell_index(box.to_unit(positions), 5).tolist() == [cell_of(p, box, 5) for p in positions.tolist()]
    outside = torch.tensor([[-0.2, 0.5, 1.0], [1.7, 0.0, -3.0]])
    assert cell_index(outside, 5).tolist() == [0 * 25 + 2 * 5 + 4, 4 * 25 + 0 + 0]


@pytest.mark.parametrize(("resolution", "training"), [(6, False), (8, True)])
def test_march_matches_loop_over_rays_and_steps(training: bool, resolution: int, box: Bounds, rays: Rays, kernels: str):
    occupied = torch.rand(resolution**3) < 0.4
    step = float((box.aabb[1] - box.aabb[0]).norm()) / 40
    near, far = box.near_far(rays)
    shift = torch.rand(len(rays)) if training else torch.zeros(len(rays))
    actual = Samples(*march(rays, box, near, far, shift, occupied, 40, step))
    total = 0
    for r in range(len(rays)):
        expected = []
        for i in range(41):
            start = min(float(near[r]) + max(i + float(shift[r]) - 0.5, 0) * step, float(far[r]))
            end = min(float(near[r]) + max(i + 1 + float(shift[r]) - 0.5, 0) * step, float(far[r]))
            point = (rays.origins[r] + (start + end) / 2 * rays.directions[r]).tolist()
            if end > start and occupied[cell_of(point, box, resolution)]:
                expected.append(((start + end) / 2, end - start))
        part = slice(int(actual.offsets[r]), int(actual.offsets[r + 1]))
        assert (actual.ray[part] == r).all()
        got = torch.stack([actual.t[part], actual.dt[part]], dim=-1)
        # Rounding may decide on a midpoint that lies on a border of cells, or on an interval of no length.
        got, wanted = got[got[:, 1] > 1e-5], torch.tensor([e for e in expected if e[1] > 1e-5]).view(-1, 2)
        torch.testing.assert_close(got, wanted, rtol=1e-4, atol=1e-4)
        total += len(wanted)
    assert total > 100


def test_march_thin_rod_is_never_missed(box: Bounds, kernels: str):
    resolution = 16
    grid = torch.zeros(resolution, resolution, resolution, dtype=torch.bool)
    grid[5, 9, :] = True
    low, side = box.aabb[0], (box.aabb[1] - box.aabb[0]) / resolution
    corner = low[:2] + torch.tensor([5.0, 9.0]) * side[:2]
    # From all around to points of the rod.
    target = torch.cat([corner + torch.rand(300, 2) * side[:2], low[2] + torch.rand(300, 1) * 16 * side[2]], dim=1)
    origins = 5 * normalize(torch.randn(300, 3), dim=-1)
    rays = Rays(origins, normalize(target - origins, dim=-1))
    every = marched(rays, box, everywhere(resolution), 200, jittered=True)
    kept = marched(rays, box, grid.flatten(), 200, jittered=True)
    position = every.positions(rays)[:, :2]
    inside = ((position > corner + 1e-5) & (position < corner + side[:2] - 1e-5)).all(-1)
    assert inside.sum() > 300
    found = set(zip(kept.ray.tolist(), kept.t.tolist(), strict=True))
    assert set(zip(every.ray[inside].tolist(), every.t[inside].tolist(), strict=True)) <= found
    margin = ((position > corner - 1e-5) & (position < corner + side[:2] + 1e-5)).all(-1)
    assert len(kept) <= int(margin.sum()), "and nothing else is kept"


@pytest.mark.parametrize("away", [2.0, 300.0])
def test_march_along_walls_matches_reference(away: float):
    """Where rounding decides on which side of a wall a step lies, a leap must not decide otherwise."""
    grid = torch.zeros(16, 16, 16, dtype=torch.bool)
    grid[:, 8:, :] = True  # from the wall of a block on
    total = 0
    for lean in (0.0, 1e-7, 1e-6, 1e-5, 1e-3, 0.3):
        generator = torch.Generator().manual_seed(1)
        sideways = lean * (2 * torch.rand(500, generator=generator) - 1)
        direction = normalize(
            torch.stack([torch.ones(500), sideways, 0.1 * torch.rand(500, generator=generator)], 1), dim=1
        )
        at = torch.stack([torch.zeros(500), 1e-6 * torch.randn(500, generator=generator), torch.zeros(500)], 1)
        rays, found = Rays(at - away * direction, direction), []
        for version in ("reference", "auto"):
            use_kernels(version)
            found.append(marched(rays, CUBE, grid.flatten(), 4000))
        assert torch.equal(found[0].t, found[1].t) and torch.equal(found[0].offsets, found[1].offsets)
        total += len(found[0])
    assert total > 1e5


@pytest.mark.parametrize("unbounded", [False, True])
def test_walk_some_steps_at_a_time_takes_same_steps(unbounded: bool, box: Bounds, rays: Rays):
    bounds = replace(box, unbounded=unbounded)
    grid = torch.rand(16**3) < 0.2
    whole = marched(rays, bounds, grid, 100, jittered=True)
    near, far = bounds.near_far(rays)
    shift, step = (
        torch.rand(near.shape, generator=torch.Generator().manual_seed(3)),
        2 * float(box.half_size.norm()) / 100,
    )
    walk = Walk(rays, bounds, near, far, shift, grid, 100, step)
    going, parts = torch.arange(len(rays)), []
    while len(going):
        parts.append(walk.on(going, 3))
        assert set(parts[-1][2].tolist()) <= set(going.tolist()) and parts[-1][3].diff().max() <= 3
        going = going[parts[-1][3].diff() == 3]
    t, dt, ray = (torch.cat([part[i] for part in parts]) for i in range(3))
    order = torch.argsort(ray, stable=True)
    assert torch.equal(t[order], whole.t) and torch.equal(dt[order], whole.dt) and torch.equal(ray[order], whole.ray)
    assert len(parts) > 3
