"""Lens models: projection and distortion, from camera-frame directions to normalized coordinates and back."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from nerf_lightning.utils.tensor_dataclass import TensorDataclass

NEWTON_STEPS = 8
"""Newton steps of `undistort`; real lenses need three or four for single precision."""
EPS = 1e-7


class Distortion(NamedTuple):
    """Distortion coefficients, the columns of `Lenses.coefficients`."""

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
"""Power of the radius in each coefficient's relative displacement, for `Lenses.zoom`."""


class Projection(IntEnum):
    """Projection of a camera-frame direction (x, y, z) to normalized coordinates."""

    PERSPECTIVE = 0
    """(x/z, y/z)."""
    FISHEYE = 1
    """Equidistant: the perspective ones times theta / tan(theta), theta the angle to the optical axis."""
    EQUIRECTANGULAR = 2
    """Longitude to the right of the optical axis and latitude downward, radians: a 360-degree panorama."""


@dataclass(frozen=True)
class Lenses(TensorDataclass):
    """Projection and distortion of V views, in OpenCV's and COLMAP's terms.

    `Projection` maps directions to normalized coordinates, the distortion displaces them, K maps them to pixels.
    """

    coefficients: Float[Tensor, "V 11"]
    """Columns as in `Distortion`."""
    projection: Int[Tensor, "V"]

    def zoom(self, factor: float) -> "Lenses":
        """Lenses for a focal length multiplied by `factor`, with the same distortion of each pixel."""
        return Lenses(self.coefficients * factor ** self.coefficients.new_tensor(DISTORTION_POWERS), self.projection)


def distort(
    normalized: Float[Tensor, "N 2"], coefficients: Float[Tensor, "#N 11"]
) -> tuple[Float[Tensor, "N 2"], Float[Tensor, "N 2 2"]]:
    """Distorts normalized coordinates.

    OpenCV's camera model (calib3d, "Detailed Description"); its k4 to k6 are d1 to d3 here. A fisheye lens is the same
    polynomial in theta.

    Returns:
        The distorted coordinates and their Jacobian.
    """
    k1, k2, k3, k4, d1, d2, d3, p1, p2, s1, s2 = coefficients.unbind(1)
    x, y = normalized.unbind(1)
    r2 = x * x + y * y
    above = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    below = 1 + r2 * (d1 + r2 * (d2 + r2 * d3))
    radial = above / below
    slope = (k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4)) - radial * (d1 + r2 * (2 * d2 + r2 * 3 * d3))) / below
    xy = 2 * x * y
    u = x * radial + p1 * xy + p2 * (r2 + 2 * x * x) + s1 * r2
    v = y * radial + p1 * (r2 + 2 * y * y) + p2 * xy + s2 * r2
    cross = xy * slope + 2 * (p1 * x + p2 * y)
    du = torch.stack([radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + 2 * s1 * x, cross + 2 * s1 * y], dim=1)
    dv = torch.stack([cross + 2 * s2 * x, radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + 2 * s2 * y], dim=1)
    return torch.stack([u, v], dim=1), torch.stack([du, dv], dim=1)


def undistort(
    distorted: Float[Tensor, "N 2"],
    coefficients: Float[Tensor, "#N 11"],
    start: Float[Tensor, "N 2"] | None = None,
    steps: int = NEWTON_STEPS,
) -> Float[Tensor, "N 2"]:
    """Inverts `distort` by Newton's method.

    Args:
        distorted: normalized coordinates with distortion.
        coefficients: see `Lenses`.
        start: initial guess; None starts from `distorted`.
        steps: number of Newton steps.
    """
    normalized = distorted if start is None else start
    for _ in range(steps):
        predicted, jacobian = distort(normalized, coefficients)
        (a, b), (c, d) = (row.unbind(1) for row in jacobian.unbind(1))
        determinant = a * d - b * c
        determinant = torch.where(determinant.abs() < EPS, EPS, determinant)
        u, v = (distorted - predicted).unbind(1)
        normalized = normalized + torch.stack([d * u - b * v, a * v - c * u], dim=1) / determinant[:, None]
    return normalized


def normalized_to_directions(normalized: Float[Tensor, "N 2"], projection: Int[Tensor, "#N"]) -> Float[Tensor, "N 3"]:
    """Directions, camera frame, not normalized, of normalized coordinates."""
    theta = normalized.norm(dim=1, keepdim=True)
    perspective = torch.cat([normalized, torch.ones_like(theta)], dim=1)
    fisheye = torch.cat([normalized * torch.sinc(theta / torch.pi), theta.cos()], dim=1)  # sin(theta) / theta
    longitude, latitude = normalized.unbind(1)
    ring = latitude.cos()
    equirectangular = torch.stack([longitude.sin() * ring, latitude.sin(), longitude.cos() * ring], dim=1)
    kind = projection[:, None]
    wide_angle = torch.where(kind == Projection.FISHEYE, fisheye, equirectangular)
    return torch.where(kind == Projection.PERSPECTIVE, perspective, wide_angle)


def directions_to_normalized(directions: Float[Tensor, "N 3"], projection: Int[Tensor, "#N"]) -> Float[Tensor, "N 2"]:
    """Inverse of `normalized_to_directions`; undefined for directions behind a perspective camera (z <= 0)."""
    xy, depth = directions[:, :2], directions[:, 2:]
    radius = xy.norm(dim=1, keepdim=True)
    perspective = xy / torch.where(depth.abs() < EPS, EPS, depth)
    fisheye = xy * torch.atan2(radius, depth) / radius.clamp_min(EPS)
    x, y, z = directions.unbind(1)
    equirectangular = torch.stack([torch.atan2(x, z), torch.atan2(y, torch.hypot(x, z))], dim=1)
    kind = projection[:, None]
    wide_angle = torch.where(kind == Projection.FISHEYE, fisheye, equirectangular)
    return torch.where(kind == Projection.PERSPECTIVE, perspective, wide_angle)
