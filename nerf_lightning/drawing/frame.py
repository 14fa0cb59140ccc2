"""One frame: what a view shows, channel beside channel."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.drawing.panels import colorize_depth, depth_limits, to_bytes
from nerf_lightning.renderer import RenderOutput
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.metrics import mse_to_psnr
from nerf_lightning.utils.text import subsample

CHANNELS = ("rgb", "depth", "opacity")
LOOKS, LOOK_SIDE = 6, 64
"""Views, and pixels along their longer side, from which the range of depths is found."""
BLACK = (0.0, 0.0, 0.0)
ERROR_TIMES = 4
"""By how much errors are magnified."""


@dataclass(frozen=True)
class Style:
    """How frames are drawn."""

    channels: tuple[str, ...]
    background: tuple[float, float, float] | None
    """What shows where nothing is, in [0, 1]; None leaves it transparent."""
    depths: tuple[float, float]
    """What is bright and what is dark in a picture of depth, in the scene's unit: one range for a whole film."""


def depth_range(system: NeRF3D, cameras: Cameras) -> tuple[float, float]:
    """The 2nd and the 98th percentile of the depths that a few of the views show, in the scene's unit."""
    small = cameras.scaled(min(1.0, LOOK_SIDE / cameras.longest))
    seen = []
    for view in subsample(len(small), LOOKS):
        rendered = system.render(small.view_rays(view).to(system.device))
        seen.append(rendered.depth[rendered.opacity > 0.5])
    return depth_limits(torch.cat(seen).cpu().numpy())


def draw(system: NeRF3D, cameras: Cameras, view: int, style: Style) -> dict[str, UInt8[ndarray, "H W C"]]:
    """A view's channels; C is 4, with straight alpha, where the background is left transparent."""
    rays = cameras.view_rays(view).to(system.device)
    rendered = system.render(rays, background=style.background or BLACK)
    width, height = cameras.size(view)
    shape = (height, width, -1)
    return {name: to_bytes(colours(rendered, name, style).view(shape)) for name in style.channels}


def colours(rendered: RenderOutput, channel: str, style: Style) -> Float[Tensor, "R C"]:
    """What one channel shows along some rays, rendered on the style's background; black stands for a transparent one."""
    opacity = rendered.opacity[:, None]
    if channel == "opacity":
        grey = opacity.expand(-1, 3)
        return grey if style.background is not None else torch.cat([grey, torch.ones_like(opacity)], dim=1)
    if channel == "rgb":
        covered = rendered.rgb  # on black: premultiplied
    else:
        painted = colorize_depth(rendered.depth.cpu().numpy(), *style.depths)
        covered = torch.from_numpy(painted).to(opacity.device) / 255 * opacity
        if style.background is not None:
            covered = covered + (1 - opacity) * torch.tensor(style.background, device=opacity.device)
    if style.background is not None:
        return covered
    return torch.cat([covered / opacity.clamp_min(1e-6), opacity], dim=1)


def error_picture(
    shown: UInt8[ndarray, "H W 3"], truth: UInt8[ndarray, "H W 3"]
) -> tuple[UInt8[ndarray, "H W 3"], float]:
    """The difference, magnified, and the PSNR in dB of the two as bytes."""
    difference = np.abs(shown.astype(np.float64) - truth)
    mse = float(np.mean((difference / 255) ** 2))
    return (ERROR_TIMES * difference).clip(0, 255).astype(np.uint8), mse_to_psnr(mse)
