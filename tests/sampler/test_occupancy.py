import math
from dataclasses import replace

import pytest
import torch
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.sampler import OccupancySampler, occupancy
from nerf_lightning.sampler.occupancy import cell_index

CUBE = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))


def nowhere(positions: Tensor) -> Tensor:
    raise AssertionError("marching does not ask the field")


def seeded(seed: int = 3) -> Generator:
    return Generator().manual_seed(seed)


def cell_of(point: list[float], bounds: Bounds, n: int) -> int:
    """The cell of a point in a bounded box, one coordinate at a time."""
    index = 0
    for x, low, high in zip(point, *bounds.aabb.tolist(), strict=True):
        index = index * n + min(max(math.floor((x - low) / (high - low) * n), 0), n - 1)
    return index


def test_cells_are_numbered_row_by_row(box: Bounds):
    points = box.aabb[0] + torch.rand(300, 3) * (box.aabb[1] - box.aabb[0])
    assert cell_index(box.to_unit(points), 5).tolist() == [cell_of(p, box, 5) for p in points.tolist()]
    outside = torch.tensor([[-0.2, 0.5, 1.0], [1.7, 0.0, -3.0]])
    assert cell_index(outside, 5).tolist() == [0 * 25 + 2 * 5 + 4, 4 * 25 + 0 + 0]


@pytest.mark.parametrize("training", [False, True])
def test_marching_agrees_with_a_loop_over_rays_and_steps(training: bool, box: Bounds, rays: Rays):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    sampler.occupied = torch.rand(6**3) < 0.4
    step = float((box.aabb[1] - box.aabb[0]).norm()) / 40
    near, far = box.near_far(rays)
    shift = torch.rand(len(rays), generator=seeded()).tolist() if training else [0.0] * len(rays)
    actual = sampler(rays, nowhere, seeded() if training else None)
    total = 0
    for r in range(len(rays)):
        expected = []
        for i in range(40):
            start = min(float(near[r]) + max(i + shift[r] - 0.5, 0) * step, float(far[r]))
            end = min(float(near[r]) + max(i + 1 + shift[r] - 0.5, 0) * step, float(far[r]))
            point = (rays.origins[r] + (start + end) / 2 * rays.directions[r]).tolist()
            if end > start and sampler.occupied[cell_of(point, box, 6)]:
                expected.append(((start + end) / 2, end - start))
        part = slice(int(actual.offsets[r]), int(actual.offsets[r + 1]))
        got = torch.stack([actual.t[part], actual.dt[part]], dim=-1)
        # Rounding may decide on a midpoint that lies on a border of cells, or on an interval of no length.
        got, wanted = got[got[:, 1] > 1e-5], torch.tensor([e for e in expected if e[1] > 1e-5]).view(-1, 2)
        torch.testing.assert_close(got, wanted, rtol=1e-4, atol=1e-4)
        total += len(wanted)
    assert total > 100


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize("training", [False, True])
def test_with_every_cell_occupied_steps_are_of_one_length(unbounded, training, box: Bounds, rays: Rays):
    bounds = replace(box, unbounded=unbounded)
    sampler = OccupancySampler(bounds, samples=64, resolution=4)
    samples = sampler(rays, nowhere, seeded() if training else None)
    near, far = bounds.near_far(rays)
    for r in range(len(rays)):
        part = slice(int(samples.offsets[r]), int(samples.offsets[r + 1]))
        if near[r] >= far[r]:
            assert part.start == part.stop
            continue
        start, end = samples.t[part] - samples.dt[part] / 2, samples.t[part] + samples.dt[part] / 2
        torch.testing.assert_close(start[1:], end[:-1], rtol=1e-5, atol=1e-5)
        if not training:
            torch.testing.assert_close(start[0], near[r], rtol=1e-4, atol=1e-4)
        if unbounded:
            assert (samples.dt[part][2:-1].diff() > -1e-4).all(), "longer and longer"
        else:
            torch.testing.assert_close(
                samples.dt[part][1:-1], torch.full_like(start[1:-1], sampler.step_length), rtol=1e-3, atol=1e-5
            )


@pytest.mark.parametrize("direction", [(1.0, 0, 0), (1.0, 1, 0), (1.0, 1, 1)])
def test_with_every_cell_occupied_rays_are_covered_to_their_end(direction):
    direction = torch.nn.functional.normalize(torch.tensor([direction]), dim=-1)
    rays = Rays(-4 * direction, direction)
    samples = OccupancySampler(CUBE, samples=4, resolution=4)(rays, nowhere)
    near, far = CUBE.near_far(rays)
    torch.testing.assert_close(samples.dt.sum(), (far - near)[0])


def test_a_rod_one_cell_thick_is_never_missed(box: Bounds):
    n, resolution = 200, 16
    sampler = OccupancySampler(box, n, resolution)
    everything = OccupancySampler(box, n, resolution)
    grid = torch.zeros(resolution, resolution, resolution, dtype=torch.bool)
    grid[5, 9, :] = True
    sampler.occupied = grid.flatten()
    low, side = box.aabb[0], (box.aabb[1] - box.aabb[0]) / resolution
    corner = low[:2] + torch.tensor([5.0, 9.0]) * side[:2]
    # From all around to points of the rod.
    target = torch.cat([corner + torch.rand(300, 2) * side[:2], low[2] + torch.rand(300, 1) * 16 * side[2]], dim=1)
    origins = 5 * torch.nn.functional.normalize(torch.randn(300, 3), dim=-1)
    rays = Rays(origins, torch.nn.functional.normalize(target - origins, dim=-1))
    every, kept = everything(rays, nowhere, seeded()), sampler(rays, nowhere, seeded())
    position = every.positions(rays)[:, :2]
    inside = ((position > corner + 1e-5) & (position < corner + side[:2] - 1e-5)).all(-1)
    assert inside.sum() > 300
    found = set(zip(kept.ray.tolist(), kept.t.tolist(), strict=True))
    assert set(zip(every.ray[inside].tolist(), every.t[inside].tolist(), strict=True)) <= found
    margin = ((position > corner - 1e-5) & (position < corner + side[:2] + 1e-5)).all(-1)
    assert len(kept) <= int(margin.sum()), "and nothing else is kept"


@pytest.mark.parametrize("candidates", [1, 100, 1000])
def test_looking_at_fewer_intervals_together_changes_nothing(candidates: int, box: Bounds, rays: Rays, monkeypatch):
    sampler = OccupancySampler(box, samples=40, resolution=6)
    sampler.occupied = torch.rand(6**3) < 0.4
    whole = sampler(rays, nowhere, seeded())
    monkeypatch.setattr(occupancy, "MAX_CANDIDATES", candidates)
    parts = sampler(rays, nowhere, seeded())
    for name in ("t", "dt", "ray", "offsets"):
        assert torch.equal(getattr(whole, name), getattr(parts, name))


def ball(centre: float = 0.0):
    return lambda x: 40.0 * ((x - torch.tensor([centre, 0, 0])).norm(dim=-1) < 0.5).float()


def cells(resolution: int) -> tuple[Tensor, float]:
    """Centres of all cells of the cube, and from there to their corners."""
    middle = (torch.arange(resolution) + 0.5) / resolution * 2 - 1
    return torch.cartesian_prod(middle, middle, middle), math.sqrt(3) / resolution


def test_updates_learn_where_the_content_is():
    sampler = OccupancySampler(CUBE, samples=64, resolution=12, warmup=64)
    assert sampler.occupied.all(), "nothing is skipped before anything is known"
    centre, corner = cells(12)
    for step in range(0, 1600, 16):
        sampler.update(step, ball(), seeded(step))
        assert sampler.occupied[centre.norm(dim=-1) < 0.5 - corner].all(), "never without content"
    assert not sampler.occupied[centre.norm(dim=-1) > 0.5 + corner].any()


def test_a_place_that_empties_is_forgotten():
    sampler = OccupancySampler(CUBE, samples=64, resolution=8, warmup=64)
    centre, corner = cells(8)
    for step in range(0, 320, 16):
        sampler.update(step, ball(-0.5), seeded(step))
    for step in range(320, 16_000, 16):
        sampler.update(step, ball(0.5), seeded(step))
    assert not sampler.occupied[centre[:, 0] < -corner].any()
    assert sampler.occupied[(centre - torch.tensor([0.5, 0, 0])).norm(dim=-1) < 0.5 - corner].all()


def test_density_anywhere_in_a_cell_is_found_in_time():
    """A speck an eighth of a cell in each direction: random places meet it sooner or later."""
    speck = torch.tensor([0.13, 0.13, 0.13])
    sampler = OccupancySampler(CUBE, samples=16, resolution=2, decay=1.0, warmup=10**6)
    for step in range(0, 16 * 1500, 16):
        sampler.update(step, lambda x: 1000.0 * ((x - speck).abs() < 0.0625).all(-1).float(), seeded(step))
    assert sampler.occupied.tolist() == [False] * 7 + [True]


@pytest.mark.parametrize("density", [1e-3, 0.1, 10.0])
def test_a_field_of_one_density_everywhere_keeps_all_its_cells(density: float):
    sampler = OccupancySampler(CUBE, samples=256, resolution=8)
    for step in range(0, 512, 16):
        sampler.update(step, lambda x: torch.full((len(x),), density), seeded(step))
    assert sampler.occupied.all()


@pytest.mark.parametrize(("share", "kept"), [(0.5, False), (2.0, True)])
def test_the_threshold_is_the_optical_thickness_of_a_step(share: float, kept: bool):
    sampler = OccupancySampler(CUBE, samples=100, resolution=4, threshold=0.02)
    thin = share * 0.02 / (2 * math.sqrt(3) / 100)
    sampler.update(0, lambda x: torch.where(x[:, 0] < 0, thin, 1000.0), seeded())
    assert sampler.occupied.tolist() == [kept] * 32 + [True] * 32


def test_an_unbounded_scene_is_learned_outside_its_box_too():
    sampler = OccupancySampler(replace(CUBE, unbounded=True), samples=64, resolution=16)
    sampler.update(0, lambda x: 10.0 * (x[:, 0] > 3).float(), seeded())
    unit = replace(CUBE, unbounded=True).to_unit(torch.tensor([[20.0, 0, 0], [0.0, 0, 0], [-20.0, 0, 0]]))
    assert sampler.occupied[cell_index(unit, 16)].tolist() == [True, False, False]


def test_updates_come_every_so_often_and_follow_the_generator():
    samplers = [OccupancySampler(CUBE, samples=64, resolution=6, warmup=32) for _ in range(2)]
    untouched = samplers[0].thickness.clone()
    for step in (1, 15, 17):
        samplers[0].update(step, nowhere, seeded())
    assert torch.equal(samplers[0].thickness, untouched)
    asked = []
    for sampler in samplers:
        for step in (0, 16, 32, 48):
            sampler.update(step, lambda x: (asked.append(len(x)), x.norm(dim=-1))[1], seeded(step))
    assert asked == [216, 216, 54, 54] * 2, "all cells, then a quarter"
    assert torch.equal(samplers[0].thickness, samplers[1].thickness)


def test_what_was_learned_is_kept_in_checkpoints():
    sampler, other = (OccupancySampler(CUBE, samples=64, resolution=6) for _ in range(2))
    sampler.update(0, ball(), seeded())
    other.load_state_dict(sampler.state_dict())
    assert torch.equal(other.occupied, sampler.occupied) and torch.equal(other.thickness, sampler.thickness)


def test_a_field_without_density_is_looked_at_everywhere():
    sampler = OccupancySampler(CUBE, samples=16, resolution=4)
    sampler.update(0, lambda x: torch.zeros(len(x)), seeded(0))
    assert sampler.occupied.all()
