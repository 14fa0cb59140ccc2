"""A small scene in every format: a colored ball off the origin, exact silhouettes, rectangular images."""

import math
from collections.abc import Callable

import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, make_circle_poses
from nerf_lightning.dataset import Scene, Views

CENTER = torch.tensor([0.3, -0.2, 0.1])
RADIUS = 0.5
WIDTH, HEIGHT, FOCAL = 48, 40, 60.0


def ball_views(per_ring: int, elevations: tuple[float, ...] = (-0.6, 0.2, 0.9), turn: float = 0.0) -> Views:
    """RGBA views from rings of cameras, 4 units away from the origin."""
    up = torch.tensor([0.0, 0.0, 1.0])
    c, s = math.cos(turn), math.sin(turn)
    spin = torch.tensor([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    c2w = torch.cat([spin @ make_circle_poses(torch.zeros(3), up, 4.0, e, per_ring) for e in elevations])
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    cameras = Cameras.pinhole(K.repeat(len(c2w), 1, 1), c2w, WIDTH, HEIGHT)
    images = []
    for view in range(len(c2w)):
        rays = cameras.generate_view_rays(view)
        to_ball = CENTER - rays.origins
        along = (to_ball * rays.directions).sum(-1)
        under = RADIUS**2 - (to_ball.square().sum(-1) - along**2)
        hit = rays.origins + (along - under.clamp_min(0).sqrt())[:, None] * rays.directions
        rgb = ((hit - CENTER) / RADIUS * 0.5 + 0.5).clamp(0, 1) * 0.8 + 0.2
        rgba = torch.cat([rgb, torch.ones_like(along)[:, None]], dim=-1) * (under > 0)[:, None]
        images.append((rgba * 255).round().to(torch.uint8).view(HEIGHT, WIDTH, 4))
    return Views.from_images(torch.stack(images), cameras)


@pytest.fixture(scope="session")
def ball_views_of() -> Callable[..., Views]:
    return ball_views


@pytest.fixture(scope="session")
def ball_box() -> torch.Tensor:
    return torch.stack([CENTER - RADIUS, CENTER + RADIUS])


@pytest.fixture(scope="session")
def ball() -> Scene:
    """9 training and 3 held-out RGBA views, an orbit of 4."""
    train, val = ball_views(3), ball_views(1, turn=0.4)
    orbit = ball_views(4, (0.3,)).cameras
    return Scene("ball", "test", train, val, orbit, Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])))
