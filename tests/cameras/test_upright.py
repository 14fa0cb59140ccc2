import math

import pytest
import torch

from nerf_lightning.cameras import Cameras, held, orbit_around, orbit_like, turn_upright

CENTRE = torch.tensor([0.4, -0.3, 0.2])
UP = torch.nn.functional.normalize(torch.tensor([0.3, 0.8, -0.5]), dim=0)


def rolled(c2w: torch.Tensor, quarters: torch.Tensor, wobble: float = 0.0) -> torch.Tensor:
    """Cameras held on their side, and not quite level."""
    angle = quarters * math.pi / 2 + wobble * torch.randn(len(c2w))
    turn = torch.eye(4).repeat(len(c2w), 1, 1)
    turn[:, 0, 0], turn[:, 0, 1] = angle.cos(), -angle.sin()
    turn[:, 1, 0], turn[:, 1, 1] = angle.sin(), angle.cos()
    return c2w @ turn


def ring(elevation: float = 0.5, share: float = 1.0, frames: int = 40) -> torch.Tensor:
    c2w = orbit_around(CENTRE, UP, 2.0, elevation, frames)
    return c2w[: int(share * frames)]


@pytest.mark.parametrize(
    ("quarters", "share", "degrees"), [(0, 1, 2), (1, 1, 2), (3, 1, 2), (0, 0.5, 5), (1, 0.5, 5), (0, 0.2, 15)]
)
def test_held_up_is_found(quarters: int, share: float, degrees: float):
    c2w = rolled(ring(share=share), torch.full((int(40 * share),), quarters), wobble=0.03)
    up, side = held(c2w)
    assert math.degrees(math.acos(float(up @ UP))) < degrees
    assert (side == {0: 0, 1: 3, 3: 1}[quarters]).all()


def test_held_portrait_and_landscape():
    quarters = torch.tensor([0, 1, 0, 3, 0] * 8)
    up, side = held(rolled(ring(), quarters, wobble=0.03))
    assert math.degrees(math.acos(float(up @ UP))) < 2
    assert side.tolist() == [{0: 0, 1: 3, 3: 1}[int(q)] for q in quarters]


def test_turn_upright_takes_up_to_z():
    for up in (UP, torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 0.0, -1.0])):
        turn = turn_upright(up)
        torch.testing.assert_close(turn @ up, torch.tensor([0.0, 0.0, 1.0]), atol=1e-6, rtol=0)
        torch.testing.assert_close(turn @ turn.T, torch.eye(3), atol=1e-6, rtol=0)
        assert float(torch.linalg.det(turn)) == pytest.approx(1)


def test_orbit_like_sideways_photos_are_portrait():
    K = torch.tensor([[100.0, 0, 44], [0, 110, 31], [0, 0, 1]]).repeat(40, 1, 1)
    cameras = Cameras.of_size(K, rolled(ring(), torch.ones(40)), 80, 60)
    orbit = orbit_like(cameras, 8)
    assert orbit.size(0) == (60, 80)
    assert orbit.K[0].diagonal().tolist() == [110, 100, 1] and orbit.K[0, :2, 2].tolist() == [30, 40]
    assert float((-orbit.c2w[:, :3, 1] @ UP).min()) > 0.8
    torch.testing.assert_close(orbit.centres.mean(0), CENTRE + 2 * math.sin(0.5) * UP, atol=1e-2, rtol=0)
