"""Look-at poses, circles of them, and the up direction of a set of cameras."""

import math

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras.cameras import Cameras

MEAN_UP_WEIGHT, MIN_MEAN_UP_WEIGHT = 2.0, 1e-6
"""Weight of the photos' mean up direction, relative to their deviation from level, and its minimum: it decides where all
cameras look the same way."""
MIN_PLANARITY_GAIN = 0.1
"""Least advantage in `planarity` of the photos' columns over their rows before the photos count as turned by 90 degrees."""


def look_at(
    eye: Float[Tensor, "*batch 3"], target: Float[Tensor, "*#batch 3"], up: Float[Tensor, "3"]
) -> Float[Tensor, "*batch 4 4"]:
    """Look-at poses at `eye`: z axis toward `target`, y axis away from `up` (OpenCV, camera to world).

    When looking along `up` itself, the roll is arbitrary.
    """
    forward = normalize(target - eye, dim=-1)
    right = torch.linalg.cross(forward, up.expand_as(forward))
    helper_axis = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    is_vertical = right.norm(dim=-1, keepdim=True) < 1e-6
    right = torch.where(is_vertical, torch.linalg.cross(forward, helper_axis.expand_as(forward)), right)
    right = normalize(right, dim=-1)
    down = torch.linalg.cross(forward, right)
    c2w = torch.eye(4, dtype=eye.dtype, device=eye.device).repeat(*eye.shape[:-1], 1, 1)
    c2w[..., :3, :] = torch.stack([right, down, forward, eye], dim=-1)
    return c2w


def make_circle_poses(
    center: Float[Tensor, "3"], up: Float[Tensor, "3"], radius: float, elevation: float, frames: int
) -> Float[Tensor, "frames 4 4"]:
    """A full circle of poses around `center`, all looking at it.

    Args:
        center: the subject, world frame.
        up: unit vector, the circle's axis.
        radius: distance to the subject, scene's unit.
        elevation: angle above the plane through `center` orthogonal to `up`, radians.
        frames: number of poses; the last stops one step short of the first, so that a loop is smooth.
    """
    a, b = horizontal_axes(up)
    angle = torch.arange(frames, dtype=up.dtype, device=up.device)[:, None] * (2 * math.pi / frames)
    ring = math.cos(elevation) * (torch.cos(angle) * a + torch.sin(angle) * b) + math.sin(elevation) * up
    return look_at(center + radius * ring, center, up)


def horizontal_axes(up: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit vectors that are perpendicular to `up` and to each other."""
    helper_axis = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    first = normalize(torch.linalg.cross(up, helper_axis), dim=-1)
    return first, torch.linalg.cross(up, first)


def mean_up(cameras: Cameras) -> Float[Tensor, "3"]:
    """Mean image-up direction of cameras: a unit vector, world frame."""
    return normalize(-cameras.c2w[:, :3, 1].mean(0), dim=0)


def find_typical_view(cameras: Cameras) -> int:
    """Index of the first view of the most common size."""
    _, size_index, counts = torch.unique(cameras.sizes, dim=0, return_inverse=True, return_counts=True)
    return int((size_index == counts.argmax()).int().argmax())


def planarity(axes: Float[Tensor, "V 3"]) -> float:
    """Planarity of unit vectors, from 0 (along one line, or in all directions) to 0.5 (everywhere in one plane)."""
    smallest, middle, _ = torch.linalg.eigvalsh(axes.mT @ axes / len(axes)).tolist()
    return middle - smallest


def estimate_up(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"]:
    """The up direction of a scene: a unit vector, world frame.

    Photos are taken level, in landscape or portrait. Around a subject, their horizontal axes span one plane; up is
    perpendicular to it.
    """
    right, down = c2w[:, :3, 0].double(), c2w[:, :3, 1].double()
    axes = torch.stack([-down, right, down, -right], dim=1)  # the candidates for up in each photo
    is_sideways = planarity(axes[:, 0]) > planarity(axes[:, 1]) + MIN_PLANARITY_GAIN
    up = normalize(axes[:, 1 if is_sideways else 0].mean(0), dim=0)
    slope = float((c2w[:, :3, 2].double() @ up).mean())
    # A portrait photo does not tell which of its sides is up: assume that people look down at their subject.
    if is_sideways and slope > 0:
        up = -up
    index = torch.arange(len(axes), device=axes.device)
    eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
    for _ in range(3):
        side = (axes @ up).argmax(1)
        mean = normalize(axes[index, side].mean(0), dim=0)
        level = axes[index, (side + 1) % 4]
        spread = level.mT @ level / len(level)
        weight = MEAN_UP_WEIGHT * torch.linalg.eigvalsh(spread)[0].clamp_min(0) + MIN_MEAN_UP_WEIGHT
        normal = torch.linalg.eigh(spread + weight * (eye - mean[:, None] * mean)).eigenvectors[:, 0]
        up = normal if float(normal @ mean) >= 0 else -normal
    return up.to(c2w.dtype)


def rotation_to_z_up(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """Smallest rotation that maps the unit vector `up` to (0, 0, 1)."""
    rotation, _ = Rotation.align_vectors([[0.0, 0.0, 1.0]], up[None].double().cpu().numpy())
    return torch.from_numpy(rotation.as_matrix()).to(up)
