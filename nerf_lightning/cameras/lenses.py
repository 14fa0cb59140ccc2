"""Lens models: from directions to places in a photo, and back."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.utils.tensor_dataclass import TensorDataclass

NEWTON_STEPS = 8
"""Steps of Newton's method that undo a distortion; real lenses need three or four for single precision."""
EPS = 1e-7


class Distortion(NamedTuple):
    """The names of the columns of `Lenses.coefficients`."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    """Radial: 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, divided by 1 + d1 r^2 + d2 r^4 + d3 r^6."""
    d1: float = 0.0
    d2: float = 0.0
    d3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    """Tangential."""
    s1: float = 0.0
    s2: float = 0.0
    """Thin prism: s1 r^2 to the right, s2 r^2 down."""


DISTORTION_POWERS = Distortion(k1=2, k2=4, k3=6, k4=8, d1=2, d2=4, d3=6, p1=1, p2=1, s1=1, s2=1)
"""Of the distance from the axis, by which each bends a place in proportion to that distance."""


class Projection(IntEnum):
    """How a direction (x, y, z) in the camera frame becomes flat coordinates."""

    PERSPECTIVE = 0
    """(x/z, y/z)."""
    FISHEYE = 1
    """Those times theta / tan(theta), where theta is the angle to the optical axis: equidistant."""
    EQUIRECTANGULAR = 2
    """Longitude to the right of the optical axis and latitude downward, radians: a photo of all directions."""


@dataclass(frozen=True)
class Lenses(TensorDataclass):
    """The projection and the distortion of V views, in OpenCV's and COLMAP's terms.

    A direction has flat coordinates, see `Projection`. The distortion moves them; K makes pixels of them.
    """

    coefficients: Float[Tensor, "V 11"]
    """See `Distortion`."""
    projection: Int[Tensor, "V"]
    """See `Projection`."""

    def zoom(self, factor: float) -> "Lenses":
        """Of cameras with that many times the focal length, which bend the same places of a photo alike: a place is bent by how
        far it lies from the axis in focal lengths."""
        return Lenses(self.coefficients * factor ** self.coefficients.new_tensor(DISTORTION_POWERS), self.projection)


def distort(
    normalized: Float[Tensor, "N 2"], coefficients: Float[Tensor, "#N 11"]
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2 2"]]:
    """Moves flat coordinates as a lens does.

    OpenCV's model of a camera (calib3d, "Detailed Description") without k4 to k6 of the same name, which are d1 to d3 here;
    a fisheye lens is the same polynomial in theta.

    Returns:
        Where they come to lie, and the Jacobian of that.
    """
    k1, k2, k3, k4, d1, d2, d3, p1, p2, s1, s2 = coefficients.unbind(1)
    x, y = normalized.unbind(1)
    r2 = x * x + y * y
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    below = 1 + r2 * (d1 + r2 * (d2 + r2 * d3))
    radial = above / below
    slope = (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)) - radial * (d1 + r2 * (2 * d2 + r2 * 3 * d3))) / below
    xy = 2 * x * y
    moved = torch.stack(
        [
            x * radial + p1 * xy + p2 * (r2 + 2 * x * x) + s1 * r2,
            y * radial + p1 * (r2 + 2 * y * y) + p2 * xy + s2 * r2,
        ],
        dim=1,
    )
    cross = xy * slope + 2 * (p1 * x + p2 * y)
    jacobian = torch.stack(
        [
            torch.stack([radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + 2 * s1 * x, cross + 2 * s1 * y], dim=1),
            torch.stack([cross + 2 * s2 * x, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + 2 * s2 * y], dim=1),
        ],
        dim=1,
    )
    return moved, jacobian


def undistort(
    distorted: Float[Tensor, "N 2"],
    coefficients: Float[Tensor, "#N 11"],
    start: Float[Tensor, "N 2"] | None = None,
    steps: int = NEWTON_STEPS,
) -> Float[Tensor, "N 2"]:
    """The inverse of `distort`, by Newton's method.

    Args:
        distorted: where the flat coordinates came to lie.
        coefficients: see `Lenses`.
        start: guesses; None starts from `distorted`.
        steps: of Newton's method.
    """
    normalized = distorted if start is None else start
    for _ in range(steps):
        moved, jacobian = distort(normalized, coefficients)
        (a, b), (c, d) = (row.unbind(1) for row in jacobian.unbind(1))
        determinant = a * d - b * c
        determinant = torch.where(determinant.abs() < EPS, EPS, determinant)
        u, v = (distorted - moved).unbind(1)
        normalized = normalized + torch.stack([d * u - b * v, a * v - c * u], dim=1) / determinant[:, None]
    return normalized


def normalized_to_directions(normalized: Float[Tensor, "N 2"], projection: Int[Tensor, "#N"]) -> Float[Tensor, "N 3"]:
    """Directions of any length, camera frame, with some flat coordinates."""
    theta = normalized.norm(dim=1, keepdim=True)
    perspective = torch.cat([normalized, torch.ones_like(theta)], dim=1)
    fisheye = torch.cat([normalized * torch.sinc(theta / torch.pi), theta.cos()], dim=1)  # sin(theta) / theta
    longitude, latitude = normalized.unbind(1)
    level = latitude.cos()
    equirectangular = torch.stack([longitude.sin() * level, latitude.sin(), longitude.cos() * level], dim=1)
    kind = projection[:, None]
    bent = torch.where(kind == Projection.FISHEYE, fisheye, equirectangular)
    return torch.where(kind == Projection.PERSPECTIVE, perspective, bent)


def directions_to_normalized(directions: Float[Tensor, "N 3"], projection: Int[Tensor, "#N"]) -> Float[Tensor, "N 2"]:
    """The inverse of `normalized_to_directions`; of no use for directions that a perspective lens does not see (z <= 0)."""
    across, ahead = directions[:, :2], directions[:, 2:]
    radius = across.norm(dim=1, keepdim=True)
    perspective = across / torch.where(ahead.abs() < EPS, EPS, ahead)
    fisheye = across * torch.atan2(radius, ahead) / radius.clamp_min(EPS)
    x, y, z = directions.unbind(1)
    equirectangular = torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], dim=1)
    kind = projection[:, None]
    bent = torch.where(kind == Projection.FISHEYE, fisheye, equirectangular)
    return torch.where(kind == Projection.PERSPECTIVE, perspective, bent)
