"""Intrinsics and lens distortion of one photo, in the terms of calibration programs."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection
from nerf_lightning.cameras.lenses import directions_to_normalized, distort

ROUNDTRIP_GRID, MAX_ROUNDTRIP_ERROR_PX = 24, 1.0
"""Pixels along each side of the round-trip check, and its largest reprojection error."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics in pixels, pixel centers at +0.5, the distortion and the projection (see `cameras.Lenses`)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Distortion = Distortion()
    projection: Projection = Projection.PERSPECTIVE

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    @property
    def opencv_distortion(self) -> Float[np.ndarray, "5"]:
        """k1, k2, p1, p2, k3, OpenCV's order: the perspective distortion that calibration estimates."""
        d = self.distortion
        return np.array([d.k1, d.k2, d.p1, d.p2, d.k3])

    @property
    def is_distorted(self) -> bool:
        """Whether this is not a pinhole camera."""
        return self.projection != Projection.PERSPECTIVE or any(self.distortion)

    def is_invertible(self) -> bool:
        """Whether the distortion is invertible: pixels survive the round trip through rays in float32, without folding."""
        return not self.is_distorted or is_invertible(self)


@lru_cache(maxsize=1)  # most captures have one lens
def is_invertible(intrinsics: Intrinsics) -> bool:
    """See `Intrinsics.is_invertible`."""
    lenses = Lenses(torch.tensor([intrinsics.distortion]).float(), torch.tensor([intrinsics.projection]))
    K = torch.from_numpy(intrinsics.K).float()[None]
    cameras = Cameras(K, torch.eye(4)[None], torch.tensor([[intrinsics.width, intrinsics.height]]), lenses)
    across, down = (torch.linspace(0, n - 1, ROUNDTRIP_GRID).long() for n in (intrinsics.width, intrinsics.height))
    row, col = torch.cartesian_prod(down, across).T
    directions = cameras.generate_rays(torch.zeros_like(row), row, col).directions
    pixels, _, _ = cameras.project(directions, 0)
    error = pixels - torch.stack([col, row], dim=1) - 0.5
    _, jacobian = distort(directions_to_normalized(directions, lenses.projection), lenses.coefficients)
    # False for NaN too.
    return bool((error.abs() < MAX_ROUNDTRIP_ERROR_PX).all() and (torch.linalg.det(jacobian) > 0).all())


def make_equirectangular(width: int, height: int) -> Intrinsics:
    """Intrinsics of an equirectangular panorama, 360 x 180 degrees, centered on the optical axis."""
    fx, fy, cx, cy = width / (2 * math.pi), height / math.pi, width / 2, height / 2
    return Intrinsics(width, height, fx, fy, cx, cy, projection=Projection.EQUIRECTANGULAR)
