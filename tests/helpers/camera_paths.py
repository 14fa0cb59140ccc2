"""Poses of captures as people take them, for tests of layouts, regions and paths."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import look_at

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
CENTER = torch.tensor([4.0, -3.0, 1.5], dtype=torch.float64)
RADIUS = 2.0


def yaw_cameras(c2w: Float[Tensor, "V 4 4"], yaw: float) -> Float[Tensor, "V 4 4"]:
    """Cameras turned to the right about their own y axis, degrees: the subject moves to the left of the photos."""
    cos, sin = math.cos(math.radians(yaw)), math.sin(math.radians(yaw))
    c2w = c2w.clone()
    c2w[:, :3, :3] @= torch.tensor([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]], dtype=c2w.dtype)
    return c2w


def ring_poses(
    count: int = 24, yaw: float = 0.0, elevation: float = 25.0, degrees: float = 360.0, radius: float = RADIUS
) -> Float[Tensor, "V 4 4"]:
    """Cameras around `CENTER`, or on an arc."""
    angle = torch.arange(count, dtype=torch.float64) * math.radians(degrees) / count
    cos, sin = math.cos(math.radians(elevation)), math.sin(math.radians(elevation))
    offset = torch.stack([cos * angle.cos(), cos * angle.sin(), torch.full_like(angle, sin)], dim=1)
    return yaw_cameras(look_at(CENTER + radius * offset, CENTER, UP), yaw)


def look_in_directions(
    centers: Float[Tensor, "V 3"], azimuth: Float[Tensor, "V"], elevation: Float[Tensor, "V"]
) -> Float[Tensor, "V 4 4"]:
    """Cameras at places that look in directions, radians."""
    level = torch.stack([azimuth.cos(), azimuth.sin()], dim=1) * elevation.cos()[:, None]
    return look_at(centers, centers + torch.cat([level, elevation.sin()[:, None]], dim=1), UP)


def pan(noise: float = 0.0, degrees: float = 360.0, count: int = 24, seed: int = 0) -> Float[Tensor, "V 4 4"]:
    """A camera on a tripod at `CENTER`, whose places are off by some noise."""
    generator = torch.Generator().manual_seed(seed)
    centers = CENTER + noise * torch.randn(count, 3, generator=generator, dtype=torch.float64)
    turn = torch.arange(count, dtype=torch.float64) * math.radians(degrees) / count
    return look_in_directions(centers, turn, 0.2 * torch.sin(3 * turn))


def forward(diverging: float, count: int = 20, seed: int = 0) -> Float[Tensor, "V 4 4"]:
    """Cameras before a wall that look along x; axes turn outward by `diverging` radians a unit, or inward."""
    generator = torch.Generator().manual_seed(seed)
    offset = torch.randn(count, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.05, 0.5, 0.3])
    return look_in_directions(CENTER + offset, diverging * offset[:, 1], diverging * offset[:, 2])


def walk(count: int = 40) -> Float[Tensor, "V 4 4"]:
    """Someone walks along a curve and looks where they go."""
    t = torch.linspace(0, 2, count, dtype=torch.float64)
    centers = CENTER + 5 * torch.stack([t.cos(), t.sin(), 0.02 * torch.sin(9 * t)], dim=1)
    return look_in_directions(centers, t + math.pi / 2, torch.zeros_like(t))


def corridor(count: int = 40) -> Float[Tensor, "V 4 4"]:
    """Someone walks straight ahead, looking a little to the left and right."""
    t = torch.linspace(0, 1, count, dtype=torch.float64)
    centers = CENTER + torch.stack([8 * t, 0.1 * torch.sin(20 * t), 0 * t], dim=1)
    return look_in_directions(centers, 0.3 * torch.sin(7 * t), torch.zeros_like(t))


def dome(count: int = 60, seed: int = 0) -> Float[Tensor, "V 4 4"]:
    """Cameras all over a hemisphere."""
    generator = torch.Generator().manual_seed(seed)
    offset = normalize(torch.randn(count, 3, generator=generator, dtype=torch.float64), dim=1)
    offset[:, 2] = offset[:, 2].abs()
    return look_at(CENTER + RADIUS * offset, CENTER, UP)
