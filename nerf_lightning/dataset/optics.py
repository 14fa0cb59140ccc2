"""The optics of one photo: its intrinsics and its lens, as calibration programs state them."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection
from nerf_lightning.cameras.lenses import distort, undistort
from nerf_lightning.dataset.lens import Lens

FOLDED = 1e-3
"""How far, in flat coordinates, an undistorted place may come to lie from where it was seen."""
SPOTS, RETURNED = 24, 1.0
"""Pixels along each side whose rays are tried, and how far from a pixel its ray may appear."""


@dataclass(frozen=True)
class Optics:
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
    def bent(self) -> bool:
        """Whether it is not a pinhole camera's."""
        return self.projection != Projection.PERSPECTIVE or any(self.distortion)

    def perspective(self) -> Lens | None:
        """The same as OpenCV's five coefficients; None where they do not suffice."""
        d = self.distortion
        if self.projection != Projection.PERSPECTIVE or any((d.k4, d.d1, d.d2, d.d3, d.s1, d.s2)):
            return None
        return Lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy, (d.k1, d.k2, d.p1, d.p2, d.k3))

    def sees_every_pixel(self) -> bool:
        """Whether each place along the border of the photo has a direction of its own, as a real lens's has, and the rays of
        pixels lead back to them."""
        if not self.bent:
            return True
        if not all(map(math.isfinite, self.distortion)):
            return False
        seen = torch.from_numpy(self._border())
        coefficients = torch.tensor([self.distortion], dtype=torch.float64)
        flat = undistort(seen, coefficients)
        back, jacobian = distort(flat, coefficients)
        upright = torch.linalg.det(jacobian) > 0
        unfolded = torch.isfinite(flat).all() and ((back - seen).abs().amax() < FOLDED) and upright.all()
        return bool(unfolded) and leads_back(self)

    def _border(self, steps: int = 16) -> Float[np.ndarray, "B 2"]:
        """Flat coordinates, distorted, along the border of the photo."""
        t = np.linspace(0, 1, steps + 1)
        edges = np.concatenate([[(a, 0.0), (a, 1.0), (0.0, a), (1.0, a)] for a in t])
        return (edges * (self.width, self.height) - (self.cx, self.cy)) / (self.fx, self.fy)


@lru_cache(maxsize=1)  # a lens is mostly that of all photos
def leads_back(optics: Optics) -> bool:
    """Whether rays through pixels all over the photo appear in it where they were cast: as training makes them, in single
    precision, which a distortion may be too strong for."""
    width, height = optics.width, optics.height
    lenses = Lenses(torch.tensor([optics.distortion]).float(), torch.tensor([optics.projection]))
    cameras = Cameras(
        torch.from_numpy(optics.K).float()[None], torch.eye(4)[None], torch.tensor([[width, height]]), lenses
    )
    across, down = (torch.linspace(0, side - 1, SPOTS).long() for side in (width, height))
    row, col = torch.cartesian_prod(down, across).T
    directions = cameras.rays(torch.zeros_like(row), row, col).directions
    places, _, _ = cameras.project(directions, 0)
    off = places - torch.stack([col, row], dim=1) - 0.5
    return bool((off.abs() < RETURNED).all())  # false for nan too


def equirectangular(width: int, height: int) -> Optics:
    """The optics of a photo of all directions, 360 degrees wide and 180 high, whose centre lies on the optical axis."""
    return Optics(
        width,
        height,
        fx=width / (2 * math.pi),
        fy=height / math.pi,
        cx=width / 2,
        cy=height / 2,
        projection=Projection.EQUIRECTANGULAR,
    )
