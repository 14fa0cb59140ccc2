import math

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import estimate_up, look_at, make_circle_poses

UPS = [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8), (0.36, 0.48, -0.8)]


def unit(*values: float) -> torch.Tensor:
    return normalize(torch.tensor(values, dtype=torch.float64), dim=-1)


@pytest.mark.parametrize(("batch", "up"), [((), UPS[1]), ((2, 3), UPS[3])])
def test_look_at_of_target_points_forward_axis_at_it(batch, up):
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
    along = look_at(target + up, target, up)[:3, :3]
    torch.testing.assert_close(along @ along.T, torch.eye(3).double(), msg="along `up` it is still a rotation")


@pytest.mark.parametrize(("up", "elevation"), [(UPS[0], -0.4), (UPS[3], 1.3)])
def test_make_circle_poses_is_a_level_circle(up, elevation):
    up, center, radius, frames = unit(*up), torch.randn(3).double(), 2.5, 7
    c2w = make_circle_poses(center, up, radius, elevation, frames)
    offset = c2w[:, :3, 3] - center
    assert c2w.shape == (frames, 4, 4)
    torch.testing.assert_close(offset.norm(dim=-1), torch.full((frames,), radius).double())
    torch.testing.assert_close(torch.asin(offset @ up / radius), torch.full((frames,), elevation).double())
    torch.testing.assert_close(c2w[:, :3, 2], -offset / radius)
    flat = normalize(offset - (offset @ up)[:, None] * up, dim=-1)
    turn = flat.roll(-1, 0)
    angle = torch.atan2(torch.linalg.cross(flat, turn) @ up, (flat * turn).sum(-1))
    torch.testing.assert_close(angle, torch.full((frames,), 2 * math.pi / frames).double())  # the last one, too


@pytest.mark.parametrize(("quarters", "fraction", "degrees"), [([0], 0.2, 15), ([1], 0.5, 5), ([0, 1, 0, 3, 0], 1, 2)])
def test_estimate_up_of_rotated_photos_finds_up(quarters: list[int], fraction: float, degrees: float):
    """Cameras around a subject, in portrait or landscape, and not quite level."""
    up = unit(0.3, 0.8, -0.5).float()
    c2w = make_circle_poses(torch.tensor([0.4, -0.3, 0.2]), up, 2.0, 0.5, 40)[: int(fraction * 40)]
    angle = torch.tensor(quarters * 40)[: len(c2w)] * math.pi / 2 + 0.03 * torch.randn(len(c2w))
    roll = torch.eye(4).repeat(len(c2w), 1, 1)
    roll[:, 0, 0], roll[:, 0, 1], roll[:, 1, 0], roll[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    assert math.degrees(math.acos(float(estimate_up(c2w @ roll) @ up))) < degrees
