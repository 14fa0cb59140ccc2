"""Drawing the frames of a video."""

import hashlib
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from nerf_lightning.drawing.channels import (
    CHANNELS,
    ERROR_GAIN,
    FrameStyle,
    make_error_image,
    measure_depth_range,
    render_channels,
)
from nerf_lightning.drawing.panels import make_panel, to_uint8
from nerf_lightning.errors import InputError
from nerf_lightning.render.camera_path import CameraPath
from nerf_lightning.render.video import Image
from nerf_lightning.renderer import composite_over
from nerf_lightning.renderer.background import COLORS
from nerf_lightning.system import NeRF3D


def parse_style(system: NeRF3D, path: CameraPath, channels: str, background: str) -> FrameStyle:
    """Parses the options `channels` and `background`.

    Raises:
        InputError: an unknown or repeated channel, an invalid color, or a background that the photos do not have.
    """
    names = tuple(name.strip() for name in channels.split(","))
    if any(name not in CHANNELS for name in names) or len(set(names)) < len(names):
        expected = f"one or more of {', '.join(CHANNELS)}, separated by commas"
        raise InputError("render", "channels", repr(channels), expected)
    red, green, blue = scene_color = system.renderer.background.color.tolist()
    if background not in ("scene", "transparent"):
        try:
            red, green, blue = COLORS.get(background) or map(float, background.split(","))
        except ValueError:
            red = green = blue = -1.0
        if not all(0 <= part <= 1 for part in (red, green, blue)):
            expected = "scene, black, white, transparent, or R,G,B in 0..1"
            raise InputError("render", "background", repr(background), expected)
    if path.photos is not None:
        if background == "transparent":
            raise InputError("render", "background", background, "a color, for a path along photos")
        if path.photos.channels == 3 and not np.allclose((red, green, blue), scene_color, atol=1e-3):
            expected = f"scene: these photos have no alpha, but a background of {[round(c, 3) for c in scene_color]}"
            raise InputError("render", "background", background, expected)
    depths = measure_depth_range(system, path.cameras) if "depth" in names else (0.0, 1.0)
    return FrameStyle(names, None if background == "transparent" else (red, green, blue), depths)


def build_manifest(path: str, system: NeRF3D, cameras: CameraPath, style: FrameStyle) -> dict[str, Any]:
    """Plain values that identify all inputs of the frames."""
    digest = hashlib.sha256()
    for tensor in (*system.state_dict().values(), cameras.cameras.K, cameras.cameras.c2w):
        digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return {
        "what": digest.hexdigest(),
        "path": path,
        "views": cameras.views,
        "size": cameras.cameras.sizes.tolist(),
        "channels": list(style.channels),
        "background": None if style.background is None else list(style.background),
    }


def draw_frame(system: NeRF3D, path: CameraPath, style: FrameStyle, index: int) -> Image:
    """Draws the channels of a view side by side; with a photo: photo, render, error, and other channels."""
    if path.photos is None:
        return np.concatenate(list(render_channels(system, path.cameras, index, style).values()), axis=1)
    assert style.background is not None  # checked by `parse_style`
    pixels = path.photos.image(index)
    background = torch.tensor(style.background).expand(pixels[..., 0].numel(), 3)
    photo = to_uint8(composite_over(pixels.flatten(0, 1), background).view(*pixels.shape[:2], 3))
    others = [name for name in style.channels if name != "rgb"]
    images = render_channels(system, path.cameras, index, replace(style, channels=("rgb", *others)))
    error, psnr = make_error_image(images["rgb"], photo)
    names = ["truth", "render", f"{ERROR_GAIN} x error", *others]
    caption = f"{' | '.join(names)}    view {path.views[index]}, {psnr:.2f} dB"
    return make_panel([photo, images["rgb"], error, *(images[name] for name in others)], caption)
