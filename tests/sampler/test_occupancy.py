import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Cameras, Rays, look_at
from nerf_lightning.kernels import cell_index, march, set_kernels
from nerf_lightning.sampler import OccupancySampler, occupancy
from nerf_lightning.sampler.occupancy import INVISIBLE_DEPTH

CUBE = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))


def seeded(seed: int = 3) -> Generator:
    return Generator().manual_seed(seed)


def rays_toward_cube(count: int, seed: int) -> Rays:
    directions = torch.nn.functional.normalize(torch.randn(count, 3, generator=seeded(seed)), dim=-1)
    offsets = torch.rand(count, 3, generator=seeded(seed + 1)) - 0.5
    return Rays(offsets - 4 * directions, directions)


def test_occupancy_solid_interior_is_queried_on_full_passes_only():
    """A hard ball: training queries its shell alone, except on full passes. Without front-to-back marching, which hides it."""
    set_kernels("reference")
    sampler = OccupancySampler(CUBE, samples=100, resolution=16, visibility_window=2)
    queries: list[Tensor] = []

    def solid(x: Tensor) -> Tensor:
        queries.append(x)
        return 500.0 * (x.norm(dim=-1) < 0.6).float()

    deepest = []
    for step in range(16 * 6):
        sampler.update(step, solid, seeded(step))
        queries.clear()
        sampler(rays_toward_cube(200, step), solid, seeded(step))
        deepest.append(min(float(x.norm(dim=-1).min()) for x in queries))
    assert all(deepest[step] < 0.2 for step in range(32)), "all cells are active at first"
    assert all((deepest[step] < 0.2) == (step % 16 == 0) for step in range(64, 96))
    assert min(deepest[step] for step in range(64, 96) if step % 16) > 0.6 - 0.4
    sampler(rays_toward_cube(200, 1000), solid)
    assert queries[-1].norm(dim=-1).min() < 0.2, "evaluation marches through all occupied cells"


def test_occupancy_cell_visible_again_is_active_again():
    sampler = OccupancySampler(CUBE, samples=100, resolution=8, visibility_window=2, decay=0.0)
    rays = Rays(torch.tensor([[-3.0, 0.1, 0.1]]), torch.tensor([[1.0, 0, 0]]))
    behind = int(cell_index(torch.tensor([[0.9, 0.55, 0.55]]), 8))
    wall = 500.0
    for step in range(16 * 12):
        if step == 16 * 8:
            wall = 0.0
        density = lambda x: torch.where(x[:, 0] < 0, wall, 500.0)  # noqa: E731, B023
        sampler.update(step, density, seeded(step))
        sampler(rays, density, seeded(step))
        if step == 16 * 8 - 1:
            assert sampler.grid.occupied[behind] and not sampler.grid.active[behind]
    middle = int(cell_index(torch.tensor([[0.51, 0.55, 0.55]]), 8))
    assert sampler.grid.active[middle] and not sampler.grid.active[behind]


def ball(center: float = 0.0):
    return lambda x: 40.0 * ((x - torch.tensor([center, 0, 0])).norm(dim=-1) < 0.5).float()


def cells(resolution: int) -> tuple[Tensor, float]:
    """Centers of all cells of the cube, and the distance from center to corner."""
    middle = (torch.arange(resolution) + 0.5) / resolution * 2 - 1
    return torch.cartesian_prod(middle, middle, middle), math.sqrt(3) / resolution


def test_occupancy_updates_find_content():
    sampler = OccupancySampler(CUBE, samples=64, resolution=12, warmup=64)
    assert sampler.grid.occupied.all(), "nothing is skipped before anything is known"
    center, corner = cells(12)
    for step in range(0, 800, 16):
        sampler.update(step, ball(), seeded(step))
        assert sampler.grid.occupied[center.norm(dim=-1) < 0.5 - corner].all(), "occupied cells stay occupied"
    assert not sampler.grid.occupied[center.norm(dim=-1) > 0.5 + corner].any()


@pytest.mark.parametrize(("share", "kept"), [(0.5, False), (2.0, True)])
def test_occupancy_threshold_is_optical_depth_of_step(share: float, kept: bool):
    sampler = OccupancySampler(CUBE, samples=100, resolution=4, threshold=0.02)
    thin = share * 0.02 / (2 * math.sqrt(3) / 100)
    sampler.update(0, lambda x: torch.where(x[:, 0] < 0, thin, 1000.0), seeded())
    assert sampler.grid.occupied.tolist() == [kept] * 32 + [True] * 32


def test_occupancy_unbounded_scene_is_learned_outside_box():
    sampler = OccupancySampler(replace(CUBE, unbounded=True), samples=64, resolution=16)
    sampler.update(0, lambda x: 10.0 * (x[:, 0] > 3).float(), seeded())
    unit = replace(CUBE, unbounded=True).to_unit(torch.tensor([[20.0, 0, 0], [0.0, 0, 0], [-20.0, 0, 0]]))
    assert sampler.grid.occupied[cell_index(unit, 16)].tolist() == [True, False, False]


def test_occupancy_mark_invisible_cells_requires_min_cameras():
    """Three cameras look along x from -4, a fourth along y: only cells in view of three may be occupied."""
    eyes = torch.tensor([[-4.0, -0.1, 0], [-4, 0, 0], [-4, 0.1, 0], [0, -4, 0]])
    targets = torch.tensor([[0.0, -0.1, 0], [0, 0, 0], [0, 0.1, 0], [0, 0, 0]])
    c2w = look_at(eyes, targets, torch.tensor([0.0, 0, 1]))
    K = torch.tensor([[80.0, 0, 8], [0, 80, 8], [0, 0, 1]]).repeat(4, 1, 1)  # a beam of 0.4 at a distance of 4
    sampler = OccupancySampler(CUBE, samples=100, resolution=16, min_cameras=3)
    sampler.mark_invisible_cells(Cameras.pinhole(K, c2w, 16, 16))
    sampler.update(0, lambda x: torch.full((len(x),), 10.0), seeded())
    grid = sampler.grid.occupied.view(16, 16, 16)
    assert grid[:, 8, 8].all() and grid[2, 8, 8] and not grid[8, 0, 8] and not grid[8, 8, 0]
    assert torch.equal(grid, sampler.grid.in_view.view(16, 16, 16)) and sampler.grid.active.sum() <= grid.sum()
    # Along the fourth camera's view samples lie only where the others look too.
    along_y = Rays(torch.tensor([[0.0, -4, 0]]), torch.tensor([[0.0, 1, 0]]))
    positions = sampler(along_y, lambda x: torch.full((len(x),), 0.1)).positions(along_y)
    assert len(positions) and positions[:, 1].abs().max() < 0.7
    near = OccupancySampler(replace(CUBE, near=4.0), samples=100, resolution=16, min_cameras=3)
    near.mark_invisible_cells(Cameras.pinhole(K, c2w, 16, 16))
    assert not near.grid.in_view.view(16, 16, 16)[2, 8, 8], "before the near distance"


def test_occupancy_resize_keeps_maximum(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(occupancy, "RESOLUTION", 8)
    sampler = OccupancySampler(CUBE, samples=100)
    sampler.grid.optical_depth.copy_(torch.rand(8**3, generator=seeded()))
    sampler.grid.occupied = sampler.grid.optical_depth > 0.5
    sampler.grid.last_visible.copy_(torch.arange(8**3))
    before = {name: getattr(sampler.grid, name).view(8, 8, 8) for name in ("optical_depth", "occupied", "last_visible")}
    sampler.set_resolution_scale(1.5)
    assert sampler.grid.resolution == 12
    for name, old in before.items():
        new = getattr(sampler.grid, name).view(12, 12, 12)
        for x, y, z in ((0, 0, 0), (1, 5, 11), (4, 7, 10)):
            ranges = [(n * 8 // 12, ((n + 1) * 8 - 1) // 12) for n in (x, y, z)]
            expected = max(float(old[i, j, k]) for i in ranges[0] for j in ranges[1] for k in ranges[2])
            assert float(new[x, y, z]) == expected, name
    sampler.requested_samples = None
    sampler.set_resolution_scale(3.0)
    assert sampler.grid.resolution == 24 and sampler.samples == 216
    assert sampler.grid.optical_depth.max() == pytest.approx(before["optical_depth"].max() * 54 / 216)


def test_occupancy_state_of_any_stage_loads():
    early, late = OccupancySampler(CUBE), OccupancySampler(CUBE)
    late.set_resolution_scale(1.25)
    late.grid.occupied = torch.rand(80**3) < 0.5
    full, rendering = OccupancySampler(CUBE), OccupancySampler(CUBE)
    full.load_state_dict(late.state_dict())
    rendering.import_state(late.export_state())
    for loaded in (full, rendering):
        assert torch.equal(loaded.grid.occupied, late.grid.occupied) and loaded.samples == late.samples == 300
    full.load_state_dict(early.state_dict())
    assert full.samples == 192 and len(full.grid.optical_depth) == 64**3


def test_occupancy_steps_behind_wall_or_in_empty_space_are_dropped():
    rays = Rays(torch.tensor([[-3.0, 0.1, 0.2]]), torch.tensor([[1.0, 0, 0]]))
    sampler = OccupancySampler(CUBE, samples=64, resolution=8)
    sampler.grid.optical_depth.fill_(1.0)

    def wall(p: Tensor) -> Tensor:
        return 1e3 * ((p[:, 0] > -0.5) & (p[:, 0] < 0.2)).float()

    for generator in (None, seeded()):
        x = sampler(rays, wall, generator).positions(rays)[:, 0]
        assert 1 <= len(x) <= 2 and (x > -0.5).all() and (x < -0.4).all()


@pytest.mark.parametrize("density", [1e-3, 0.1])
def test_occupancy_evaluation_keeps_fog(density: float, box: Bounds, rays: Rays, kernels: str):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    step = sampler.step_size(sampler.samples)
    total = march(rays, box, torch.zeros(len(rays)), sampler.grid.occupied, 40, step)[1].sum()
    dropped = density * (total - sampler(rays, lambda x: torch.full((len(x),), density)).dt.sum())
    assert 0 <= dropped <= len(rays) * INVISIBLE_DEPTH * (1 + 1e-5)
    assert dropped > 0 or density * step > INVISIBLE_DEPTH
