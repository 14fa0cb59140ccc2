"""The optics of one photo: its intrinsics and its lens, as calibration programs state them."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection
from nerf_lightning.cameras.lenses import directions_to_normalized, distort

ROUNDTRIP_GRID, MAX_ROUNDTRIP_ERROR_PX = 24, 1.0
"""Pixels along each side whose rays are tried, and how far from a pixel its ray may appear."""


@dataclass(frozen=True)
class Intrinsics:
    """Intrinsics in pixels, pixel centres at +0.5, the distortion and the projection (see `cameras.Lenses`)."""

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
        """k1, k2, p1, p2, k3, in OpenCV's order: all of a perspective lens's distortion that a calibration finds."""
        d = self.distortion
        return np.array([d.k1, d.k2, d.p1, d.p2, d.k3])

    @property
    def is_distorted(self) -> bool:
        """Whether it is not a pinhole camera's."""
        return self.projection != Projection.PERSPECTIVE or any(self.distortion)

    def is_invertible(self) -> bool:
        """Whether each pixel has a direction of its own, as with a real lens: rays through pixels all over the photo appear
        where they were cast, unfolded, in the single precision of training, which a distortion may be too strong for."""
        return not self.is_distorted or is_invertible(self)


@lru_cache(maxsize=1)  # a lens is mostly that of all photos
def is_invertible(intrinsics: Intrinsics) -> bool:
    """See `Intrinsics.is_invertible`."""
    lenses = Lenses(torch.tensor([intrinsics.distortion]).float(), torch.tensor([intrinsics.projection]))
    K = torch.from_numpy(intrinsics.K).float()[None]
    cameras = Cameras(K, torch.eye(4)[None], torch.tensor([[intrinsics.width, intrinsics.height]]), lenses)
    across, down = (
        torch.linspace(0, side - 1, ROUNDTRIP_GRID).long() for side in (intrinsics.width, intrinsics.height)
    )
    row, col = torch.cartesian_prod(down, across).T
    directions = cameras.generate_rays(torch.zeros_like(row), row, col).directions
    places, _, _ = cameras.project(directions, 0)
    off = places - torch.stack([col, row], dim=1) - 0.5
    _, jacobian = distort(directions_to_normalized(directions, lenses.projection), lenses.coefficients)
    return bool(
        (off.abs() < MAX_ROUNDTRIP_ERROR_PX).all() and (torch.linalg.det(jacobian) > 0).all()
    )  # false for nan too


def make_equirectangular(width: int, height: int) -> Intrinsics:
    """The optics of a photo of all directions, 360 degrees wide and 180 high, whose centre lies on the optical axis."""
    return Intrinsics(
        width,
        height,
        fx=width / (2 * math.pi),
        fy=height / math.pi,
        cx=width / 2,
        cy=height / 2,
        projection=Projection.EQUIRECTANGULAR,
    )
