"""Channels of a rendered frame (rgb, depth, opacity), and error images."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.drawing.panels import colorize_depth, depth_percentiles, to_uint8
from nerf_lightning.renderer import RenderOutput
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.utils.text import subsample

CHANNELS = ("rgb", "depth", "opacity")
DEPTH_PROBE_VIEWS, DEPTH_PROBE_SIDE_PX = 6, 64
"""Number of views, and their longest side, for measuring the range of depths."""
BLACK = (0.0, 0.0, 0.0)
ERROR_GAIN = 4
"""Magnification of error images."""


@dataclass(frozen=True)
class FrameStyle:
    """Channels, background and depth range of rendered frames."""

    channels: tuple[str, ...]
    background: tuple[float, float, float] | None
    """Color in [0, 1]; None for a transparent background."""
    depth_range: tuple[float, float]
    """Bright and dark end of the depth colormap, scene's unit: fixed for a whole video."""


def measure_depth_range(system: NeRF3D, cameras: Cameras) -> tuple[float, float]:
    """Renders a few views and returns the 2nd and 98th percentile of their depths, scene's unit."""
    small = cameras.rescale(min(1.0, DEPTH_PROBE_SIDE_PX / cameras.max_side))
    visible_depths = []
    for view in subsample(len(small), DEPTH_PROBE_VIEWS):
        rendered = system.render(small.generate_view_rays(view).to(system.device))
        visible_depths.append(rendered.depth[rendered.opacity > 0.5])
    return depth_percentiles(torch.cat(visible_depths).cpu().numpy())


def render_channels(
    system: NeRF3D, cameras: Cameras, view: int, style: FrameStyle
) -> dict[str, UInt8[ndarray, "H W C"]]:
    """Renders the channels of a view; C is 4, with straight alpha, for a transparent background."""
    rays = cameras.generate_view_rays(view).to(system.device)
    width, height = cameras.size(view)
    rendered = system.render(rays, background=style.background or BLACK, width=width)
    shape = (height, width, -1)
    return {name: to_uint8(render_channel(rendered, name, style).view(shape)) for name in style.channels}


def render_channel(rendered: RenderOutput, channel: str, style: FrameStyle) -> Float[Tensor, "R C"]:
    """Colors of one channel, of rays rendered on the style's background (black for a transparent one)."""
    opacity = rendered.opacity[:, None]
    if channel == "opacity":
        gray = opacity.expand(-1, 3)
        return gray if style.background is not None else torch.cat([gray, torch.ones_like(opacity)], dim=1)
    if channel == "rgb":
        premultiplied = rendered.rgb  # rendered on black
    else:
        colors = colorize_depth(rendered.depth.cpu().numpy(), *style.depth_range)
        premultiplied = torch.from_numpy(colors).to(opacity.device) / 255 * opacity
        if style.background is not None:
            premultiplied = premultiplied + (1 - opacity) * torch.tensor(style.background, device=opacity.device)
    if style.background is not None:
        return premultiplied
    return torch.cat([premultiplied / opacity.clamp_min(1e-6), opacity], dim=1)


def make_error_image(
    shown: UInt8[ndarray, "H W 3"], truth: UInt8[ndarray, "H W 3"]
) -> tuple[UInt8[ndarray, "H W 3"], float]:
    """Magnified absolute difference, and the PSNR in dB of the two images."""
    difference = np.abs(shown.astype(np.float64) - truth)
    mse = float(np.mean((difference / 255) ** 2))
    return (ERROR_GAIN * difference).clip(0, 255).astype(np.uint8), mse_to_psnr(mse)
