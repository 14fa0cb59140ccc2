"""Pictures for a browser: coarse at first, then finer, and dropped as soon as they are out of date."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from nerf_lightning.cameras import Cameras
from nerf_lightning.drawing.frame import Style, colours, depth_range
from nerf_lightning.drawing.panels import to_bytes
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.device import synchronize
from nerf_lightning.utils.text import subsample

SLICE = 4
"""Chunks of rays rendered between two checks of whether the picture is still wanted."""
FIRST_SIDE = 24
"""Pixels along the longer side below which no picture is worth sending."""


@dataclass(frozen=True)
class Wish:
    """The picture that a browser asks for."""

    c2w: Float[ndarray, "4 4"]
    """OpenCV frame, camera to world."""
    fov: float
    """Vertical, radians."""
    aspect: float
    """Width over height."""
    channel: str
    background: tuple[float, float, float]
    near: float
    """World units along each ray; nearer parts are cut away."""
    far: float
    most: int
    """Pixels along the longer side of the finest picture."""

    def cameras(self, side: int) -> Cameras:
        """One view, `side` pixels along its longer side."""
        width = max(1, round(side * min(1.0, self.aspect)))
        height = max(1, round(side / max(1.0, self.aspect)))
        focal = height / (2 * math.tan(self.fov / 2))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Cameras.of_size(K[None], torch.from_numpy(self.c2w).float()[None], width, height)


class Painter:
    """Renders wishes with a system, at sizes that suit the speed measured so far.

    Args:
        system: trained, or in training.
        orbit: views from which the range of depths is found.
    """

    def __init__(self, system: NeRF3D, orbit: Cameras):
        self.system = system
        self.orbit = orbit
        self.rate = 50_000.0
        """Rays a second, measured; at first a guess."""
        self._depths: tuple[float, float] | None = None

    def side_within(self, wish: Wish, seconds: float) -> int:
        """Pixels along the longer side of a picture that should take `seconds`."""
        area = self.rate * seconds
        ratio = min(wish.aspect, 1 / wish.aspect)
        return int(min(max(math.sqrt(area / ratio), FIRST_SIDE), wish.most))

    def depths(self) -> tuple[float, float]:
        """The range of depths, from bright to dark."""
        if self._depths is None:
            self._depths = depth_range(self.system, self.orbit[torch.tensor(subsample(len(self.orbit), 3))])
        return self._depths

    def forget(self) -> None:
        """Called when the field has changed: the range of depths is out of date."""
        self._depths = None

    def paint(self, wish: Wish, side: int, wanted: Callable[[], bool]) -> UInt8[ndarray, "H W 3"] | None:
        """A picture of one size; None if it was no longer wanted before it was finished."""
        style = Style((wish.channel,), wish.background, self.depths() if wish.channel == "depth" else (0.0, 1.0))
        device, together = self.system.device, SLICE * self.system.chunk_rays
        synchronize(device)  # do not count work that is still queued
        began = time.perf_counter()
        cameras = wish.cameras(side).to(device)
        rays = cameras.view_rays(0)
        parts = []
        for start in range(0, len(rays), together):
            if not wanted():
                return None
            rendered = self.system.render(rays[start : start + together], wish.near, wish.far, wish.background)
            parts.append(colours(rendered, wish.channel, style))
        picture = to_bytes(torch.cat(parts).view(cameras.height, cameras.width, 3))
        self.rate = 0.5 * self.rate + 0.5 * len(rays) / max(time.perf_counter() - began, 1e-4)
        return np.ascontiguousarray(picture)
