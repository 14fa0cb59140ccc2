"""Progressive rendering for browsers: coarse to fine, canceled when outdated."""

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
"""Chunks of rays rendered between two checks for cancellation."""
MIN_SIDE = 24
"""Minimum longer side of an image, pixels."""


@dataclass(frozen=True)
class ViewRequest:
    """Camera and options of an image that a browser requests."""

    c2w: Float[ndarray, "4 4"]
    """OpenCV frame, camera to world."""
    fov: float
    """Vertical, radians."""
    aspect: float
    """Width over height."""
    channel: str
    background: tuple[float, float, float]
    near: float
    """Near clipping distance along rays, world units."""
    far: float
    max_side: int
    """Longer side of the finest image, pixels."""

    def cameras(self, side: int) -> Cameras:
        """The camera at `side` pixels along the longer side."""
        width = max(1, round(side * min(1.0, self.aspect)))
        height = max(1, round(side / max(1.0, self.aspect)))
        focal = height / (2 * math.tan(self.fov / 2))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        return Cameras.pinhole(K[None], torch.from_numpy(self.c2w).float()[None], width, height)


class ProgressiveRenderer:
    """Renders requests at resolutions chosen from the measured speed.

    Args:
        system: trained, or in training.
        orbit: views that determine the depth range.
    """

    def __init__(self, system: NeRF3D, orbit: Cameras):
        self.system = system
        self.orbit = orbit
        self.rays_per_second = 50_000.0
        """Running mean of the rendering speed; initially a guess."""
        self._depths: tuple[float, float] | None = None

    def estimate_side(self, request: ViewRequest, seconds: float) -> int:
        """Longer side of an image that takes about `seconds` to render, pixels."""
        area = self.rays_per_second * seconds
        ratio = min(request.aspect, 1 / request.aspect)
        return int(min(max(math.sqrt(area / ratio), MIN_SIDE), request.max_side))

    def get_depth_range(self) -> tuple[float, float]:
        """Depth range of the color map, bright to dark; cached."""
        if self._depths is None:
            self._depths = measure_depth_range(self.system, self.orbit[torch.tensor(subsample(len(self.orbit), 3))])
        return self._depths

    def reset_depth_range(self) -> None:
        """Discards the cached depth range, after the field has changed."""
        self._depths = None

    def render(self, request: ViewRequest, side: int, is_current: Callable[[], bool]) -> UInt8[ndarray, "H W 3"] | None:
        """Renders a request at one resolution; None if canceled by `is_current`."""
        depths = self.get_depth_range() if request.channel == "depth" else (0.0, 1.0)
        style = FrameStyle((request.channel,), request.background, depths)
        device = self.system.device
        synchronize(device)  # exclude queued work from the timing
        began = time.perf_counter()
        cameras = request.cameras(side).to(device)
        rays, width = cameras.generate_view_rays(0), cameras.width
        batch_size = max(2, CHUNKS_PER_CHECK * self.system.chunk_rays // width) * width  # whole rows
        parts = []
        for start in range(0, len(rays), batch_size):
            if not is_current():
                return None
            chunk = rays[start : start + batch_size]
            rendered = self.system.render(chunk, request.near, request.far, request.background, width)
            parts.append(render_channel(rendered, request.channel, style))
        image = to_uint8(torch.cat(parts).view(cameras.height, cameras.width, 3))
        self.rays_per_second = 0.5 * self.rays_per_second + 0.5 * len(rays) / max(time.perf_counter() - began, 1e-4)
        return np.ascontiguousarray(image)
