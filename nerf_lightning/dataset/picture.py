"""Pictures for 2D fields: from a file, or the built-in one."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.dataset.formats.image_files import read_pixels

Plane = Float[np.ndarray, "H W"]
Colors = Float[np.ndarray, "H W 3"]
SUN_POSITION = (0.66, 0.30)
"""Sun of the built-in picture, as a fraction of its width and height."""


def load_picture(path: Path) -> UInt8[Tensor, "H W 3"]:
    """Reads an image as 8-bit sRGB: EXIF rotation applied, 16 bits reduced, gray to RGB, alpha over white.

    Raises:
        InputError: missing, truncated, not an image, or floating-point pixels.
    """
    pixels = read_pixels(path, upright=True)
    if pixels.shape[2] == 4:
        alpha = pixels[..., 3:].astype(np.float32) / 255
        pixels = np.rint(pixels[..., :3] * alpha + 255 * (1 - alpha)).astype(np.uint8)
    return torch.from_numpy(pixels)


def make_builtin_picture(size: int = 256) -> UInt8[Tensor, "size size 3"]:
    """Draws a sunset over water, with detail at all scales: smooth sky, sharp hills, ripples finer towards the horizon."""
    fine = 2 * size  # 2x2 supersampling
    grid = (np.arange(fine) + 0.5) / fine
    x, y = np.meshgrid(grid, grid)
    horizon = 0.62
    picture = _draw_sky(x, y, horizon)
    for height, swing, seed, color in (
        (0.17, 0.085, 1.0, (0.45, 0.25, 0.50)),
        (0.09, 0.060, 2.3, (0.28, 0.15, 0.40)),
        (0.03, 0.045, 4.1, (0.13, 0.08, 0.26)),
    ):
        ridge = horizon - height - swing * sum(np.sin(2**k * 3.1 * x + seed * (k + 1)) / 1.7**k for k in range(6)) / 2
        picture = np.where((y > ridge)[..., None], np.array(color), picture)
    picture = np.where((y > horizon)[..., None], _draw_water(x, y, horizon), picture)
    picture = picture.reshape(size, 2, size, 2, 3).mean((1, 3))
    return torch.from_numpy(np.rint(picture * 255).clip(0, 255).astype(np.uint8))


def _draw_sky(x: Plane, y: Plane, horizon: float) -> Colors:
    stops = np.array([0.0, 0.35, 0.7, 1.0])
    colors = np.array([[0.09, 0.13, 0.36], [0.45, 0.27, 0.56], [0.95, 0.48, 0.40], [1.0, 0.80, 0.45]])
    t = (y / horizon).clip(0, 1)
    sky = np.stack([np.interp(t, stops, colors[:, c]) for c in range(3)], axis=-1)
    distance = np.hypot(x - SUN_POSITION[0], y - SUN_POSITION[1])
    glow = np.exp(-((distance / 0.20) ** 2))[..., None]
    sky = sky + glow * (np.array([1.0, 0.85, 0.5]) - sky) * 0.8
    sky = np.where((distance < 0.095)[..., None], np.array([1.0, 0.96, 0.78]), sky)
    return _draw_balloon(sky, x, y)


def _draw_balloon(sky: Colors, x: Plane, y: Plane) -> Colors:
    u, v = (x - 0.25) / 0.12, (y - 0.185) / 0.12
    taper = np.where(v > 0, np.sqrt((1 - (v / 1.35) ** 2).clip(0, 1)), np.sqrt((1 - v**2).clip(0, 1)))
    gore = np.floor(np.arcsin((u / taper.clip(1e-6)).clip(-1, 1)) * 7 / np.pi + 8.5).astype(int) % 4
    colors = np.array([[0.90, 0.20, 0.22], [0.98, 0.86, 0.36], [0.10, 0.55, 0.62], [0.97, 0.95, 0.90]])
    shade = (1.0 - 0.35 * (u + 0.3) ** 2)[..., None]
    envelope = (np.abs(u) < taper) & (v > -1) & (v < 1.15)
    sky = np.where(envelope[..., None], colors[gore] * shade, sky)
    basket = (np.abs(u) < 0.16) & (v > 1.38) & (v < 1.62)
    ropes = (np.abs(np.abs(u) - 0.16 - 0.9 * (1.38 - v)) < 0.018) & (v >= 1.15) & (v <= 1.38)
    return np.where((basket | ropes)[..., None], np.array([0.30, 0.16, 0.10]), sky)


def _draw_water(x: Plane, y: Plane, horizon: float) -> Colors:
    near = ((y - horizon) / (1 - horizon)).clip(1e-3, 1)
    # Perspective: equal waves crowd together as 1/near, up to the pixel grid's limit and past it at the horizon.
    depth = 1 / (near + 0.07)
    swell = np.sin(17 * depth + 2.5 * np.sin(5 * x + 3 * near)) * np.sin(7 * (x - 0.5) * depth + 4 * near)
    chop = np.sin(41 * depth + 9 * x * depth) * np.cos(23 * depth - 14 * x * depth)
    wave = 0.7 * swell + 0.3 * chop
    deep, bright = np.array([0.07, 0.16, 0.34]), np.array([0.96, 0.60, 0.42])
    mix = ((0.62 - 0.5 * near) + 0.30 * wave)[..., None].clip(0, 1)
    water = deep + mix * (bright - deep)
    path = np.exp(-(((x - SUN_POSITION[0]) / (0.05 + 0.10 * near)) ** 2)) * (wave > -0.1)
    return water + path[..., None] * (np.array([1.0, 0.93, 0.70]) - water) * 0.85
