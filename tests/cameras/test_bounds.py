import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.cameras.bounds import unwarp, warp

BOX = torch.tensor([[-1.0, -0.5, 0.2], [1.5, 2.0, 1.0]])


def sample_random_rays(count: int) -> Rays:
    origins = torch.randn(count, 3) * 3
    toward = BOX.mean(0) + torch.randn(count, 3)
    return Rays(origins, torch.nn.functional.normalize(toward - origins, dim=-1))


AXES = torch.cat([torch.eye(3), -torch.eye(3)])
RAYS = {
    "random": lambda: sample_random_rays(200),
    "parallel to an axis, through": lambda: Rays(BOX.mean(0) - 4 * AXES, AXES),
    "parallel to an axis, outside": lambda: Rays(BOX[1] + 0.1 - 4 * AXES, AXES),
    "inside": lambda: Rays(BOX[0] + torch.rand(100, 3) * (BOX[1] - BOX[0]), sample_random_rays(100).directions),
    "leaving": lambda: Rays(BOX[1] + 0.1 + torch.rand(50, 3), sample_random_rays(50).directions.abs()),
}


@pytest.mark.parametrize("kind", RAYS)
def test_near_far_of_random_rays_agrees_with_marching(kind):
    rays = RAYS[kind]()
    near, far = Bounds(BOX).near_far(rays)
    assert near.isfinite().all() and far.isfinite().all()
    step = 0.005
    t = np.arange(0, 20, step)
    x = rays.origins.numpy()[:, None] + t[:, None] * rays.directions.numpy()[:, None]
    inside = ((x >= BOX[0].numpy()) & (x <= BOX[1].numpy())).all(-1)
    for ray in range(len(rays)):
        if inside[ray].any():
            first, last = t[inside[ray]][[0, -1]]
            assert first - step - 1e-4 <= near[ray] <= first + 1e-4
            assert last - 1e-4 <= far[ray] <= last + step + 1e-4
        else:
            assert far[ray] - near[ray] < step
    if kind in ("parallel to an axis, outside", "leaving"):
        assert (near >= far).all()
    if kind == "inside":
        assert (near == 0).all() and (far > 0).all()


@pytest.mark.parametrize(("unbounded", "reach"), [(False, 1.1), (True, 0.9), (True, 20.0)])
def test_to_world_of_unit_positions_inverts_to_unit(unbounded, reach):
    bounds = Bounds(BOX.double(), unbounded)
    world = bounds.center + reach * bounds.half_size * torch.rand(500, 3).double().mul(2).sub(1)
    torch.testing.assert_close(bounds.to_world(bounds.to_unit(world)), world)
    unit = torch.rand(500, 3).double()
    torch.testing.assert_close(bounds.to_unit(bounds.to_world(unit)), unit)


def test_to_unit_unbounded_contracts_outside_positions():
    torch.testing.assert_close(Bounds(BOX).to_unit(BOX), torch.tensor([[0.0, 0, 0], [1, 1, 1]]))
    bounds = Bounds(BOX, unbounded=True)
    torch.testing.assert_close(bounds.to_unit(BOX), torch.tensor([[0.25] * 3, [0.75] * 3]))
    far = bounds.to_unit(torch.randn(1000, 3) * torch.logspace(-2, 8, 1000)[:, None])
    assert far.min() >= 0 and far.max() <= 1
    # Twice and ten times the half-size along x: |x| = 2 - 1/r, a quarter of the cube for each unit.
    away = bounds.center + torch.tensor([[2.0, 0, 0], [-10.0, 0, 0]]) * bounds.half_size
    torch.testing.assert_close(bounds.to_unit(away)[:, 0], torch.tensor([0.5 + 0.25 * 1.5, 0.5 - 0.25 * 1.9]))
    assert bounds.to_world(torch.tensor([[0.0, 1.0, 0.5], [1.0, 1.0, 1.0]])).isfinite().all()


def test_near_far_with_overrides_narrows_and_unbounded_extends():
    rays = RAYS["inside"]()
    _, exit = Bounds(BOX).near_far(rays)
    start, end = Bounds(BOX, near=0.5, far=2.0).near_far(rays)
    torch.testing.assert_close(start, torch.full_like(start, 0.5))
    torch.testing.assert_close(end, exit.clamp(max=2.0))
    near, far = Bounds(BOX, unbounded=True).near_far(sample_random_rays(4))
    torch.testing.assert_close(near, torch.full((4,), 0.02 * 1.25))
    torch.testing.assert_close(far, torch.full((4,), 50 * 1.25))


def rays_along_x(*starts: list[float]) -> Rays:
    return Rays(torch.tensor(starts), torch.tensor([[1.0, 0.0, 0.0]]).expand(len(starts), -1))


def test_s_to_t_unbounded_steps_grow_outside_the_box():
    """A cube of half-size 2, hit, entered from inside, missed, and far behind: by hand."""
    cube = Bounds(torch.tensor([[-2.0, -2, -2], [2, 2, 2]]), unbounded=True)
    rays = rays_along_x([-8.0, 0, 0], [1.0, 0, 0], [-8.0, 5, 0], [30.0, 0, 0])
    expected = torch.tensor([[6.0, 10.0], [-3.0, 1.0], [8.0, 8.0], [-32.0, -28.0]])
    torch.testing.assert_close(cube.content_interval(rays), expected)
    # Six before the box are three half-sizes, 3 / 4 of all there is before; then two in it; ten behind it are 5 / 6.
    even = torch.tensor([[-3 / 4, 0.0, 1.0, 2.0, 2 + 1 / 2, 2 + 5 / 6]])
    t = torch.tensor([[0.0, 6.0, 8.0, 10.0, 12.0, 20.0]])
    inside, unit = cube.content_interval(rays), 2.0
    torch.testing.assert_close(warp(t, inside[:1], unit), even)
    torch.testing.assert_close(unwarp(even, inside[:1], unit), t)
    near, far = torch.zeros(4), torch.full((4,), 40.0)
    edges = cube.s_to_t(rays, near, far, torch.linspace(0, 1, 401).expand(4, -1))
    steps = edges.diff(dim=1)
    t = edges[:, :-1] + steps / 2
    beyond = torch.stack([inside[:, :1] - t, t - inside[:, 1:]]).amax(0).clamp_min(0) / 2
    torch.testing.assert_close(edges[:, [0, -1]], torch.stack([near, far], dim=1), atol=1e-4, rtol=1e-4)
    growth = steps / (1 + beyond) ** 2
    torch.testing.assert_close(growth, growth.median(dim=1, keepdim=True).values.expand_as(growth), rtol=1e-2, atol=0)


def test_core_spaces_cells_in_perspective_and_samples_in_disparity():
    """With a core around the cameras a cell covers nearly as many pixels near as far, and steps grow with t^2."""
    box, core = torch.tensor([[-1.0, -1, -1], [1, 1, 1]]), torch.tensor([[-0.25, -1.25, -0.25], [0.25, -0.75, 0.25]])
    bounds = Bounds(box, unbounded=True, near=0.25, pixel_footprint=0.002, core=core)
    distance = torch.tensor([0.25, 0.5, 1.0, 4.0])
    along = torch.stack([0 * distance, distance - 1, 0 * distance], dim=1)
    aside = along + 0.002 * distance[:, None] * torch.tensor([1.0, 0.0, 0.0])
    per_pixel = (bounds.to_unit(aside) - bounds.to_unit(along))[:, 0]
    torch.testing.assert_close(per_pixel, 0.0005 * (2 - 0.25 / distance))
    assert bounds.unit_cube_pixels == pytest.approx(1 / float(per_pixel[2]), rel=1e-4)
    assert Bounds(box, unbounded=True, pixel_footprint=0.002).unit_cube_pixels == pytest.approx(2000)
    rays = Rays(torch.tensor([[0.0, -1, 0]]), torch.tensor([[0.0, 1, 0]]))
    edges = bounds.s_to_t(rays, *bounds.near_far(rays), torch.linspace(0, 1, 9)[None])
    torch.testing.assert_close((1 / edges).diff(dim=1), (1 / edges).diff(dim=1).mean().expand(1, 8), rtol=1e-3, atol=0)
    positions = along + torch.tensor([0.3, 0.1, -0.2])
    torch.testing.assert_close(bounds.to_world(bounds.to_unit(positions)), positions)
