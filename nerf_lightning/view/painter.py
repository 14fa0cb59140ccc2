"""Pictures that are due soon: coarse at once, then finer, and dropped as soon as another one is wanted."""

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
from nerf_lightning.renderer import Rendered
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.device import synchronize
from nerf_lightning.utils.evenly import evenly

SLICE = 4
"""So many times what is sampled together is painted between two looks at whether the picture is still wanted."""
FIRST_SIDE = 24
"""Pixels along the longer side below which no picture is worth sending."""


@dataclass(frozen=True)
class Wish:
    """What somebody wants to see."""

    c2w: Float[ndarray, "4 4"]
    """OpenCV frame, camera to world."""
    fov: float
    """Vertical, radians."""
    aspect: float
    """Width over height."""
    channel: str
    background: tuple[float, float, float]
    near: float
    """World units along each ray; what is nearer is cut away."""
    far: float
    most: int
    """Pixels along the longer side of the finest picture."""

    def cameras(self, side: int) -> Cameras:
        """As one view with so many pixels along its longer side."""
        width = max(1, round(side * min(1.0, self.aspect)))
        height = max(1, round(side / max(1.0, self.aspect)))
        focal = height / (2 * math.tan(self.fov / 2))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Cameras(K[None], torch.from_numpy(self.c2w).float()[None], width, height)


class Painter:
    """Renders wishes with a system, at sizes that its speed so far allows.

    Args:
        system: trained, or in training.
        orbit: views that tell the range of depths.
    """

    def __init__(self, system: NeRF3D, orbit: Cameras):
        self.system = system
        self.orbit = orbit
        self.rate = 50_000.0
        """Rays a second, as last measured; a guess before."""
        self._depths: tuple[float, float] | None = None

    def side_within(self, wish: Wish, seconds: float) -> int:
        """Pixels along the longer side of a picture that should take so long."""
        area = self.rate * seconds
        ratio = min(wish.aspect, 1 / wish.aspect)
        return int(min(max(math.sqrt(area / ratio), FIRST_SIDE), wish.most))

    def depths(self) -> tuple[float, float]:
        """What is bright and what is dark in pictures of depth."""
        if self._depths is None:
            self._depths = depth_range(self.system, self.orbit[torch.tensor(evenly(len(self.orbit), 3))])
        return self._depths

    def forget(self) -> None:
        """Called when the field has changed: the range of depths is looked for again."""
        self._depths = None

    def paint(self, wish: Wish, side: int, wanted: Callable[[], bool]) -> UInt8[ndarray, "H W 3"] | None:
        """A picture of one size; None where it was no longer wanted before it was done."""
        device, together = self.system.device, SLICE * self.system.chunk_rays
        synchronize(device)  # what it still does for others is not the picture's time
        began = time.perf_counter()
        cameras = wish.cameras(side).to(device)
        rays = cameras.view_rays(0)
        parts = []
        for start in range(0, len(rays), together):
            if not wanted():
                return None
            parts.append(self.system.render(rays[start : start + together], wish.near, wish.far, wish.background))
        rendered = Rendered(
            *(torch.cat([getattr(part, name) for part in parts]) for name in ("rgb", "opacity", "distance"))
        )
        depths = self.depths() if wish.channel == "depth" else (0.0, 1.0)
        painted = colours(rendered, wish.channel, Style((wish.channel,), wish.background, depths))
        picture = to_bytes(painted.view(cameras.height, cameras.width, 3))
        self.rate = 0.5 * self.rate + 0.5 * len(rays) / max(time.perf_counter() - began, 1e-4)
        return np.ascontiguousarray(picture)
