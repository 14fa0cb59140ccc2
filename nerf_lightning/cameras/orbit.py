"""Poses that look at a subject, and the subject that poses look at."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras.cameras import Cameras


def look_at(
    eye: Float[Tensor, "*batch 3"], target: Float[Tensor, "*#batch 3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Poses at `eye` whose z axis points at `target` and whose y axis points away from `up` (OpenCV, camera to world).

    When looking along `up` itself, the roll is arbitrary.
    """
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    right = torch.linalg.cross(forward, up.expand_as(forward))
    other = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    along = right.norm(dim=-1, keepdim=True) < 1e-6
    right = torch.where(along, torch.linalg.cross(forward, other.expand_as(forward)), right)
    right = torch.nn.functional.normalize(right, dim=-1)
    down = torch.linalg.cross(forward, right)
    c2w = torch.eye(4, dtype=eye.dtype, device=eye.device).repeat(*eye.shape[:-1], 1, 1)
    c2w[..., :3, :] = torch.stack([right, down, forward, eye], dim=-1)
    return c2w


def orbit_around(
    centre: Float[Tensor, "3"], up: Float[Tensor, "3"], radius: float, elevation: float, frames: int
) -> Float[Tensor, "frames 4 4"]:
    """A full circle of poses around `centre`, all looking at it.

    Args:
        centre: the subject, world frame.
        up: unit vector, the circle's axis.
        radius: distance to the subject, scene's unit.
        elevation: angle above the plane through `centre` orthogonal to `up`, radians.
        frames: number of poses; the last stops one step short of the first, so that a loop is smooth.
    """
    helper = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    a = torch.nn.functional.normalize(torch.linalg.cross(up, helper), dim=-1)
    b = torch.linalg.cross(up, a)
    angle = torch.arange(frames, dtype=up.dtype, device=up.device)[:, None] * (2 * math.pi / frames)
    ring = math.cos(elevation) * (torch.cos(angle) * a + torch.sin(angle) * b) + math.sin(elevation) * up
    return look_at(centre + radius * ring, centre, up)


def upward(cameras: Cameras) -> Float[Tensor, "3"]:
    """What is up in the pictures of cameras, on average: a unit vector, world frame."""
    return torch.nn.functional.normalize(-cameras.c2w[:, :3, 1].mean(0), dim=0)


def typical_view(cameras: Cameras) -> int:
    """The first view of the commonest size."""
    _, which, counts = torch.unique(cameras.sizes, dim=0, return_inverse=True, return_counts=True)
    return int((which == counts.argmax()).int().argmax())
