"""Ray marching through an occupancy grid, and marking of the samples' cells."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import filter_visible, march, march_until_opaque, mark_cells, ray_positions, set_kernels
from nerf_lightning.kernels.march import Packed
from nerf_lightning.sampler import Samples
from tests.helpers.kernel_comparison import run_with_threads

CUBE = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))


def cell_of(point: list[float], bounds: Bounds, n: int) -> int:
    """The cell of a point in a bounded box, one coordinate at a time."""
    index = 0
    for x, low, high in zip(point, *bounds.aabb.tolist(), strict=True):
        index = index * n + min(max(math.floor((x - low) / (high - low) * n), 0), n - 1)
    return index


@pytest.mark.parametrize(("resolution", "training"), [(6, False), (8, True)])
def test_march_matches_loop_over_rays_and_steps(training: bool, resolution: int, box: Bounds, rays: Rays, kernels: str):
    occupied = torch.rand(resolution**3) < 0.4
    step = float((box.aabb[1] - box.aabb[0]).norm()) / 40
    near, far = box.near_far(rays)
    shift = torch.rand(len(rays)) if training else torch.zeros(len(rays))
    actual = Samples(*march(rays, box, shift, occupied, 40, step))
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
        # Rounding decides midpoints on cell borders and intervals of length 0.
        got, expected_kept = got[got[:, 1] > 1e-5], torch.tensor([e for e in expected if e[1] > 1e-5]).view(-1, 2)
        torch.testing.assert_close(got, expected_kept, rtol=1e-4, atol=1e-4)
        total += len(expected_kept)
    assert total > 100


@pytest.mark.parametrize("distance", [2.0, 300.0])
def test_march_along_walls_matches_reference(distance: float):
    """Leaps agree with the reference where rounding decides on which side of a wall a step lies."""
    grid = torch.zeros(16, 16, 16, dtype=torch.bool)
    grid[:, 8:, :] = True  # from the wall of a block on
    total = 0
    for lean in (0.0, 1e-7, 1e-6, 1e-5, 1e-3, 0.3):
        generator = torch.Generator().manual_seed(1)
        sideways = lean * (2 * torch.rand(500, generator=generator) - 1)
        rising = 0.1 * torch.rand(500, generator=generator)
        direction = normalize(torch.stack([torch.ones(500), sideways, rising], 1), dim=1)
        at = torch.stack([torch.zeros(500), 1e-6 * torch.randn(500, generator=generator), torch.zeros(500)], 1)
        rays, results = Rays(at - distance * direction, direction), []
        for version in ("reference", "auto"):
            set_kernels(version)
            step = 2 * 3**0.5 / 4000
            found = march(rays, CUBE, torch.zeros(500), grid.flatten(), 4000, step)
            results.append(Samples(*found))
        assert torch.equal(results[0].t, results[1].t) and torch.equal(results[0].offsets, results[1].offsets)
        total += len(results[0])
    assert total > 1e5


@pytest.mark.parametrize("unbounded", [False, True])
def test_mark_cells_marks_cells_of_samples(unbounded: bool, box: Bounds, rays: Rays, kernels: str):
    bounds, resolution = replace(box, unbounded=unbounded), 6
    ray, t = torch.randint(0, len(rays), (60,)), 6 * torch.rand(60)  # some of them outside
    marks = torch.full((resolution**3,), 3, dtype=torch.int32)
    positions = ray_positions(rays.origins, rays.directions, ray, t)
    mark_cells(marks, 7, bounds, positions)
    expected = torch.full_like(marks, 3)
    for place in positions:
        x, y, z = (int(min(max(float(u) * resolution, 0), resolution - 1)) for u in bounds.to_unit(place))
        expected[(x * resolution + y) * resolution + z] = 7
    assert torch.equal(marks, expected) and {3, 7} == set(marks.tolist())
    mark_cells(marks, 9, bounds, positions[:0])
    assert torch.equal(marks, expected), "no samples, no marks"


EPS = 0.01

STEP = 2 * math.sqrt(3) / 100


def shells(positions: Tensor) -> Tensor:
    """Density of fog in shells."""
    return 40 * (12 * positions.norm(dim=1)).sin().clamp_min(0)


def march_shells(rays: Rays, occupied: Tensor) -> tuple[Tensor, Packed, int]:
    """Optical depths and intervals, and the number of queried positions."""
    queries = []

    def optical_depth(packed: Packed) -> Tensor:
        queries.append(len(packed[0]))
        t, dt, ray, _ = packed
        return shells(rays.origins.detach()[ray] + t[:, None] * rays.directions[ray]) * dt

    shift = torch.rand(len(rays), generator=torch.Generator().manual_seed(3))
    depths, packed = march_until_opaque(rays, CUBE, shift, occupied, 100, STEP, optical_depth, EPS)
    return depths, packed, sum(queries)


@pytest.mark.parametrize("occupied_fraction", [0.0, 0.3, 1.0])
def test_march_until_opaque_any_occupancy_finds_visible_samples(occupied_fraction: float):
    directions = normalize(torch.randn(400, 3), dim=1)
    offsets = torch.cat([torch.rand(396, 3) - 0.5, torch.full((4, 3), 5.0)])  # the last miss
    rays = Rays(offsets - 4 * directions, directions)
    occupied = torch.rand(16**3) < occupied_fraction
    set_kernels("reference")
    expected, every, most = march_shells(rays, occupied)
    set_kernels("auto")
    depths, packed, queries = march_shells(rays, occupied)
    for min_optical_depth in (0.0, 0.05):
        kept, intervals, _ = filter_visible(depths, packed, EPS, min_optical_depth)
        expected_kept, others, _ = filter_visible(expected, every, EPS, min_optical_depth)
        assert all(torch.equal(a, b) for a, b in zip((kept, *intervals), (expected_kept, *others), strict=True))
    assert queries == len(depths) and (len(depths) < 0.7 * most or occupied_fraction < 1)
    again = run_with_threads(lambda: march_shells(rays, occupied), 2 if torch.get_num_threads() == 1 else 1)
    assert torch.equal(depths, again[0]) and torch.equal(packed[0], again[1][0])
