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
from nerf_lightning.drawing.channels import FrameStyle, measure_depth_range, render_channel
from nerf_lightning.drawing.panels import to_uint8
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.device import synchronize
from nerf_lightning.utils.text import subsample

CHUNKS_PER_CHECK = 4
"""Chunks of rays rendered between two checks of whether the picture is still wanted."""
MIN_SIDE = 24
"""Pixels along the longer side below which no picture is worth sending."""


@dataclass(frozen=True)
class ViewRequest:
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
    max_side: int
    """Pixels along the longer side of the finest picture."""

    def cameras(self, side: int) -> Cameras:
        """One view, `side` pixels along its longer side."""
        width = max(1, round(side * min(1.0, self.aspect)))
        height = max(1, round(side / max(1.0, self.aspect)))
        focal = height / (2 * math.tan(self.fov / 2))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Cameras.pinhole(K[None], torch.from_numpy(self.c2w).float()[None], width, height)


class ProgressiveRenderer:
    """Renders wishes with a system, at sizes that suit the speed measured so far.

    Args:
        system: trained, or in training.
        orbit: views from which the range of depths is found.
    """

    def __init__(self, system: NeRF3D, orbit: Cameras):
        self.system = system
        self.orbit = orbit
        self.rays_per_second = 50_000.0
        """Rays a second, measured; at first a guess."""
        self._depths: tuple[float, float] | None = None

    def estimate_side(self, wish: ViewRequest, seconds: float) -> int:
        """Pixels along the longer side of a picture that should take `seconds`."""
        area = self.rays_per_second * seconds
        ratio = min(wish.aspect, 1 / wish.aspect)
        return int(min(max(math.sqrt(area / ratio), MIN_SIDE), wish.max_side))

    def get_depth_range(self) -> tuple[float, float]:
        """The range of depths, from bright to dark."""
        if self._depths is None:
            self._depths = measure_depth_range(self.system, self.orbit[torch.tensor(subsample(len(self.orbit), 3))])
        return self._depths

    def reset_depth_range(self) -> None:
        """Called when the field has changed: the range of depths is out of date."""
        self._depths = None

    def render(self, wish: ViewRequest, side: int, is_current: Callable[[], bool]) -> UInt8[ndarray, "H W 3"] | None:
        """A picture of one size; None if it was no longer wanted before it was finished."""
        style = FrameStyle(
            (wish.channel,), wish.background, self.get_depth_range() if wish.channel == "depth" else (0.0, 1.0)
        )
        device, together = self.system.device, CHUNKS_PER_CHECK * self.system.chunk_rays
        synchronize(device)  # do not count work that is still queued
        began = time.perf_counter()
        cameras = wish.cameras(side).to(device)
        rays = cameras.generate_view_rays(0)
        parts = []
        for start in range(0, len(rays), together):
            if not is_current():
                return None
            rendered = self.system.render(rays[start : start + together], wish.near, wish.far, wish.background)
            parts.append(render_channel(rendered, wish.channel, style))
        picture = to_uint8(torch.cat(parts).view(cameras.height, cameras.width, 3))
        self.rays_per_second = 0.5 * self.rays_per_second + 0.5 * len(rays) / max(time.perf_counter() - began, 1e-4)
        return np.ascontiguousarray(picture)
