"""Poses that look at a subject, and which way is up, from how cameras were held."""

import math

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras.cameras import Cameras

MEAN_UP_WEIGHT, MIN_MEAN_UP_WEIGHT = 2.0, 1e-6
"""Weight of the mean up direction of all photos: a multiple of how far from level they were held, and the least. It decides
where all cameras look the same way."""
MIN_PLANARITY_GAIN = 0.1
"""By how much the photos' rows must be less flat (see `planarity`) than their columns for them to lie on their side."""


def look_at(
    eye: Float[Tensor, "*batch 3"], target: Float[Tensor, "*#batch 3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Poses at `eye` whose z axis points at `target` and whose y axis points away from `up` (OpenCV, camera to world).

    When looking along `up` itself, the roll is arbitrary.
    """
    forward = normalize(target - eye, dim=-1)
    right = torch.linalg.cross(forward, up.expand_as(forward))
    other = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    is_vertical = right.norm(dim=-1, keepdim=True) < 1e-6
    right = torch.where(is_vertical, torch.linalg.cross(forward, other.expand_as(forward)), right)
    right = normalize(right, dim=-1)
    down = torch.linalg.cross(forward, right)
    c2w = torch.eye(4, dtype=eye.dtype, device=eye.device).repeat(*eye.shape[:-1], 1, 1)
    c2w[..., :3, :] = torch.stack([right, down, forward, eye], dim=-1)
    return c2w


def make_circle_poses(
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
    a, b = horizontal_axes(up)
    angle = torch.arange(frames, dtype=up.dtype, device=up.device)[:, None] * (2 * math.pi / frames)
    ring = math.cos(elevation) * (torch.cos(angle) * a + torch.sin(angle) * b) + math.sin(elevation) * up
    return look_at(centre + radius * ring, centre, up)


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit vectors that are perpendicular to `up` and to each other."""
    other = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    first = normalize(torch.linalg.cross(up, other), dim=-1)
    return first, torch.linalg.cross(up, first)


def mean_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """What is up in the pictures of cameras, on average: a unit vector, world frame."""
    return normalize(-cameras.c2w[:, :3, 1].mean(0), dim=0)


def find_typical_view(cameras: Cameras) -> int:
    """The first view of the commonest size."""
    _, which, counts = torch.unique(cameras.sizes, dim=0, return_inverse=True, return_counts=True)
    return int((which == counts.argmax()).int().argmax())


def planarity(axes: Float[Tensor, "V 3"]) -> float:
    """How surely unit vectors point everywhere in one plane, from 0 (all along one line, or in all directions) to 0.5."""
    smallest, middle, _ = torch.linalg.eigvalsh(axes.mT @ axes / len(axes)).tolist()
    return middle - smallest


def estimate_up(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"]:
    """Which way is up: a unit vector, world frame.

    Photos are taken level, upright or on their side. All around a subject, their level axes point everywhere in one plane;
    up is perpendicular to it.
    """
    right, down = c2w[:, :3, 0].double(), c2w[:, :3, 1].double()
    axes = torch.stack([-down, right, down, -right], dim=1)  # that may be up in each photo
    sideways = planarity(axes[:, 0]) > planarity(axes[:, 1]) + MIN_PLANARITY_GAIN
    up = normalize(axes[:, 1 if sideways else 0].mean(0), dim=0)
    slope = float((c2w[:, :3, 2].double() @ up).mean())
    # Which side of a photo that lies on its side is up it does not tell; people look down at what they photograph.
    if sideways and slope > 0:
        up = -up
    pick = torch.arange(len(axes), device=axes.device)
    eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
    for _ in range(3):
        side = (axes @ up).argmax(1)
        mean = normalize(axes[pick, side].mean(0), dim=0)
        level = axes[pick, (side + 1) % 4]
        spread = level.mT @ level / len(level)
        weight = MEAN_UP_WEIGHT * torch.linalg.eigvalsh(spread)[0].clamp_min(0) + MIN_MEAN_UP_WEIGHT
        normal = torch.linalg.eigh(spread + weight * (eye - mean[:, None] * mean)).eigenvectors[:, 0]
        up = normal if float(normal @ mean) >= 0 else -normal
    return up.to(c2w.dtype)


def rotation_to_z_up(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """The smallest rotation that takes `up`, a unit vector, to (0, 0, 1)."""
    turn, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], up[None].double().cpu().numpy())
    return torch.from_numpy(turn.as_matrix()).to(up)
