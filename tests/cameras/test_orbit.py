import math

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Cameras, look_at, orbit_around, orbit_like

UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8), (0.36, 0.48, -0.8)]


def unit(*values: float) -> torch.Tensor:
    return normalize(torch.tensor(values, dtype=torch.float64), dim=-1)


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
def test_look_at_points_at_the_target(batch, up):
    up, target = unit(*up), torch.randn(3).double()
    eye = target + 4 * torch.randn(*batch, 3).double()
    c2w = look_at(eye, target, up)
    R, x, y, z = c2w[..., :3, :3], *c2w[..., :3, :3].unbind(-1)
    assert c2w.shape == (*batch, 4, 4)
    torch.testing.assert_close(eye + z * (target - eye).norm(dim=-1, keepdim=True), target.expand_as(eye))
    assert (y @ up < 0).all(), "y points down"
    assert (x @ up).abs().max() < 1e-12, "the horizon is level"
    torch.testing.assert_close(R.mT @ R, torch.eye(3).double().expand_as(R))
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(batch).double())
    assert torch.equal(c2w[..., :3, 3], eye)
    assert torch.equal(c2w[..., 3, :], torch.tensor([0, 0, 0, 1.0]).double().expand(*batch, 4))


@pytest.mark.parametrize("up", UPS)
@pytest.mark.parametrize("elevation", [-0.4, 0.0, 0.5, 1.3])
def test_orbit_around_is_a_level_circle(up, elevation):
    up, centre, radius, frames = unit(*up), torch.randn(3).double(), 2.5, 7
    c2w = orbit_around(centre, up, radius, elevation, frames)
    offset = c2w[:, :3, 3] - centre
    assert c2w.shape == (frames, 4, 4)
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((frames,), radius).double())
    torch.testing.assert_close(torch.asin(offset @ up / radius), torch.full((frames,), elevation).double())
    torch.testing.assert_close(c2w[:, :3, 2], -offset / radius)
    flat = normalize(offset - (offset @ up)[:, None] * up, dim=-1)
    turn = flat.roll(-1, 0)
    angle = torch.atan2(torch.linalg.cross(flat, turn) @ up, (flat * turn).sum(-1))
    torch.testing.assert_close(angle, torch.full((frames,), 2 * math.pi / frames).double())  # the last one, too


def inward(count: int, centre: torch.Tensor, spread: float = 1.0) -> torch.Tensor:
    """Cameras in front of and around `centre`, optical axes through it."""
    eye = centre + torch.tensor([0, -4.0, 0]) + spread * torch.randn(count, 3)
    return look_at(eye, centre, torch.tensor([0.0, 0, 1]))


@pytest.mark.parametrize("elevation", [-0.3, 0.0, 0.7])
def test_orbit_like_all_around_is_the_same_circle(elevation):
    centre, up = torch.tensor([1.0, 2.0, -0.5]), unit(0.6, 0.0, 0.8).float()
    K = torch.eye(3).repeat(12, 1, 1) * torch.arange(1.0, 13)[:, None, None]
    cameras = Cameras.of_size(K, orbit_around(centre, up, 3.0, elevation, 12), 40, 30)
    orbit = orbit_like(cameras, frames=5)
    offset = orbit.centres - centre
    assert len(orbit) == 5 and (orbit.width, orbit.height) == (40, 30)
    assert torch.equal(orbit.K, K[:1].expand(5, 3, 3))
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((5,), 3.0), atol=1e-3, rtol=0)
    torch.testing.assert_close(offset @ up / 3, torch.full((5,), math.sin(elevation)), atol=1e-3, rtol=0)
    torch.testing.assert_close(orbit.c2w[:, :3, 2], -normalize(offset, dim=-1), atol=1e-3, rtol=0)


@pytest.mark.parametrize("spread", [0.2, 1.0])
def test_orbit_like_one_side_stays_there(spread):
    centre = torch.tensor([1.0, 2.0, -0.5])
    c2w = inward(30, centre, spread)
    orbit = orbit_like(Cameras.of_size(torch.eye(3).repeat(30, 1, 1), c2w, 4, 4), frames=8)
    seen, shown = normalize(c2w[:, :3, 3] - centre, dim=-1), normalize(orbit.centres - centre, dim=-1)
    middle = normalize(seen.mean(0), dim=-1)
    assert (shown @ middle).min() > (seen @ middle).min()
    torch.testing.assert_close(orbit.c2w[:, :3, 2], -shown, atol=1e-3, rtol=0)
    assert (orbit.c2w[:, 2, 1] < 0).all(), "upright, as the photos are"
    assert (shown[0] - shown[4]).norm() > 0.02, "a loop, not a point"


@pytest.mark.parametrize("frames", [1, 4])
def test_orbit_like_single_camera_is_finite(frames):
    one = Cameras.of_size(torch.eye(3)[None], inward(1, torch.zeros(3)), 4, 4)
    assert orbit_like(one, frames).c2w.isfinite().all()


def test_look_at_straight_down_is_a_rotation():
    c2w = look_at(torch.tensor([[0.0, 0.0, 2.0]]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    torch.testing.assert_close(c2w[0, :3, :3] @ c2w[0, :3, :3].T, torch.eye(3))
    torch.testing.assert_close(torch.linalg.det(c2w[0, :3, :3]), torch.tensor(1.0))
