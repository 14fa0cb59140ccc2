"""The optics of one photo: its intrinsics and its lens, as calibration programs state them."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection
from nerf_lightning.cameras.lenses import distort, to_flat

SPOTS, MAX_RETURN_ERROR_PX = 24, 1.0
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
    def opencv(self) -> Float[np.ndarray, "5"]:
        """k1, k2, p1, p2, k3, in OpenCV's order: all of a perspective lens's distortion that a calibration finds."""
        d = self.distortion
        return np.array([d.k1, d.k2, d.p1, d.p2, d.k3])

    @property
    def bent(self) -> bool:
        """Whether it is not a pinhole camera's."""
        return self.projection != Projection.PERSPECTIVE or any(self.distortion)

    def sees_every_pixel(self) -> bool:
        """Whether each pixel has a direction of its own, as with a real lens: rays through pixels all over the photo appear
        where they were cast, unfolded, in the single precision of training, which a distortion may be too strong for."""
        return not self.bent or sees_every_pixel(self)


@lru_cache(maxsize=1)  # a lens is mostly that of all photos
def sees_every_pixel(optics: Intrinsics) -> bool:
    """See `Intrinsics.sees_every_pixel`."""
    lenses = Lenses(torch.tensor([optics.distortion]).float(), torch.tensor([optics.projection]))
    K = torch.from_numpy(optics.K).float()[None]
    cameras = Cameras(K, torch.eye(4)[None], torch.tensor([[optics.width, optics.height]]), lenses)
    across, down = (torch.linspace(0, side - 1, SPOTS).long() for side in (optics.width, optics.height))
    row, col = torch.cartesian_prod(down, across).T
    directions = cameras.rays(torch.zeros_like(row), row, col).directions
    places, _, _ = cameras.project(directions, 0)
    off = places - torch.stack([col, row], dim=1) - 0.5
    _, jacobian = distort(to_flat(directions, lenses.projection), lenses.coefficients)
    return bool((off.abs() < MAX_RETURN_ERROR_PX).all() and (torch.linalg.det(jacobian) > 0).all())  # false for nan too


def equirectangular(width: int, height: int) -> Intrinsics:
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
