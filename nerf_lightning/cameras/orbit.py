"""Camera paths around a subject."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras.cameras import Cameras
from nerf_lightning.cameras.upright import held

ONE_SIDED = 0.35
"""Length of the mean viewing direction's horizontal part above which the cameras are all on one side of the subject."""
MEETING = 0.25
"""See `axes_meet`."""
MOSTLY = 0.7
"""Share of the views that lie within a loop before the subject."""
STEEPEST = 1.4
"""Largest angle above the subject in such a loop, radians."""


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


def focus_point(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"]:
    """The point nearest to all optical axes in the least-squares sense: what the cameras look at.

    Solves sum_v (I - d_v d_v^T) (x - o_v) = 0; a small ridge pulls toward the mean centre, so that parallel axes
    (one view, a flat sweep) still give a finite point.
    """
    centres = c2w[:, :3, 3].double()
    axes = torch.nn.functional.normalize(c2w[:, :3, 2].double(), dim=-1)
    eye = torch.eye(3, dtype=torch.float64, device=c2w.device)
    projectors = eye - axes[:, :, None] * axes[:, None, :]
    mean = centres.mean(0)
    A = projectors.mean(0) + 1e-8 * eye
    b = (projectors @ (centres - mean)[:, :, None]).mean(0)[:, 0]
    return (mean + torch.linalg.solve(A, b)).to(c2w.dtype)


def axes_meet(c2w: Float[Tensor, "V 4 4"]) -> bool:
    """Whether the optical axes meet in `focus_point`: they pass it, on average, within a share of the cameras' distance to it.

    They do not in a panorama or a fly-through.
    """
    offset = focus_point(c2w) - c2w[:, :3, 3]
    axes = torch.nn.functional.normalize(c2w[:, :3, 2], dim=1)
    beside = (offset - (offset * axes).sum(1, keepdim=True) * axes).norm(dim=1)
    return float(beside.mean()) <= MEETING * float(offset.norm(dim=1).mean())


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


def swing_before(
    centre: Float[Tensor, "3"], up: Float[Tensor, "3"], offset: Float[Tensor, "V 3"], radius: float, frames: int
) -> Float[Tensor, "frames 4 4"]:
    """A closed loop of poses on the side of a subject from which it was seen, all looking at it: to the left and right, up and
    down, as far as most of the views.

    Args:
        centre: the subject, world frame.
        up: unit vector.
        offset: from the subject to each view, world units; they lie on one side.
        radius: distance to the subject, scene's unit.
        frames: number of poses; the last stops one step short of the first.
    """
    direction = torch.nn.functional.normalize(offset, dim=-1)
    mean = direction.mean(0)
    front = torch.nn.functional.normalize(mean - (mean @ up) * up, dim=-1)
    right = torch.linalg.cross(up, front)
    azimuth, elevation = torch.atan2(direction @ right, direction @ front), torch.asin((direction @ up).clamp(-1, 1))
    middle, height = azimuth.median(), elevation.median()
    wide, high = (angle.abs().quantile(MOSTLY) for angle in (azimuth - middle, elevation - height))
    turn = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    around, above = middle + wide * torch.cos(turn), (height + high * torch.sin(turn)).clamp(-STEEPEST, STEEPEST)
    level = torch.cos(around)[:, None] * front + torch.sin(around)[:, None] * right
    eye = centre + radius * (torch.cos(above)[:, None] * level + torch.sin(above)[:, None] * up)
    return look_at(eye, centre, up)


def orbit_like(cameras: Cameras, frames: int = 60) -> Cameras:
    """A closed path around what `cameras` look at, on the sides they saw, upright, with the lens of a typical one.

    Cameras all around give a full turn at their mean distance and height; cameras on one side give a loop there, as wide
    and as high as most of them.
    """
    centre = focus_point(cameras.c2w)
    up, sides = held(cameras.c2w)
    offset = cameras.centres - centre
    radius = float(offset.norm(dim=-1).mean())
    direction = torch.nn.functional.normalize(offset, dim=-1)
    mean = direction.mean(0)
    aside = mean - (mean @ up) * up  # near zero for cameras all around, whatever their height
    if float(aside.norm()) > ONE_SIDED:
        c2w = swing_before(centre, up, offset, radius, frames)
    else:
        elevation = math.asin(max(-0.95, min(0.95, float((offset @ up).mean()) / max(radius, 1e-9))))
        c2w = orbit_around(centre, up, radius, elevation, frames)
    typical = typical_view(cameras)
    K, (width, height) = cameras.K[typical], cameras.size(typical)
    if int(sides[typical]) % 2 == 1:  # it lies on its side
        K, width, height = on_its_side(K, width, height), height, width
    return Cameras.of_size(K.repeat(frames, 1, 1), c2w, width, height)


def upward(cameras: Cameras) -> Float[Tensor, "3"]:
    """What is up in the pictures of cameras, on average: a unit vector, world frame."""
    return torch.nn.functional.normalize(-cameras.c2w[:, :3, 1].mean(0), dim=0)


def typical_view(cameras: Cameras) -> int:
    """The first view of the commonest size."""
    _, which, counts = torch.unique(cameras.sizes, dim=0, return_inverse=True, return_counts=True)
    return int((which == counts.argmax()).int().argmax())


def on_its_side(K: Float[Tensor, "3 3"], width: int, height: int) -> Float[Tensor, "3 3"]:
    """Intrinsics of a photo turned by a quarter, with its principal point in the middle."""
    turned = torch.eye(3, dtype=K.dtype, device=K.device)
    turned[0, 0], turned[1, 1], turned[0, 2], turned[1, 2] = K[1, 1], K[0, 0], height / 2, width / 2
    return turned


SPIRAL_TURNS, SPIRAL_CLIMB = 2, 0.75
"""Turns of a spiral, and how much of the way to its axis it climbs."""


def spiral_like(orbit: Cameras, frames: int = 60) -> Cameras:
    """A closed path that winds from an orbit up to its axis and back, at the same distance, with the same size and intrinsics.

    Args:
        orbit: a circle of cameras that look at its middle or beside it, as `orbit_like` gives; a path of another shape
            counts as the circle it resembles.
        frames: number of poses; the last stops one step short of the first.
    """
    centre = focus_point(orbit.c2w)
    up = upward(orbit)
    offset = orbit.centres - centre
    radius = offset.norm(dim=-1).mean()
    mean = offset.mean(0)
    axis = torch.linalg.svd(offset - mean).Vh[2]  # across the circle's plane
    side = mean if mean.norm() > 1e-3 * radius else up  # a circle at the subject's own height has no mean offset
    axis = axis * torch.where(axis @ side < 0, -1.0, 1.0)
    angle = torch.acos((torch.nn.functional.normalize(offset, dim=-1) @ axis).clamp(-1, 1)).mean()
    first = torch.nn.functional.normalize(offset[0] - (offset[0] @ axis) * axis, dim=-1)
    second = torch.linalg.cross(axis, first)
    turn = torch.arange(frames, dtype=axis.dtype)[:, None] * (2 * math.pi / frames)
    slope = angle * (1 - SPIRAL_CLIMB * (1 - torch.cos(turn)) / 2)
    around = torch.cos(SPIRAL_TURNS * turn) * first + torch.sin(SPIRAL_TURNS * turn) * second
    eye = centre + radius * (torch.sin(slope) * around + torch.cos(slope) * axis)
    return Cameras.of_size(orbit.K[:1].repeat(frames, 1, 1), look_at(eye, centre, up), orbit.width, orbit.height)
