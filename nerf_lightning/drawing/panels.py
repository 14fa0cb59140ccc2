"""Image panels with captions, depth colormaps, and image encoding."""

import base64
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image
from torch import Tensor

from nerf_lightning.dataset.resize import fit_size, resize_area
from nerf_lightning.system import ViewResult
from nerf_lightning.utils.files import atomic_write

MIN_PANEL_HEIGHT_PX = 160
"""Panels below this height are magnified by whole factors, so that the caption stays readable."""
MAX_CHART_SIDE_PX = 2048
"""Longest side of an image in a chart."""
MAX_PANEL_WIDTH_PX = 1024
"""Widest image in a panel: a run keeps dozens of panels, and `final.png` has the full resolution."""


def to_uint8(image: Float[Tensor, "*shape"]) -> UInt8[ndarray, "*shape"]:
    """Converts [0, 1] to bytes on the CPU, rounded and clamped."""
    return image.clamp(0, 1).mul_(255).round_().byte().cpu().numpy()


def depth_percentiles(depths: Float[ndarray, "*shape"]) -> tuple[float, float]:
    """The 2nd and 98th percentile of depths; 0 and 1 if there are none."""
    if not depths.size:
        return 0.0, 1.0
    low, high = np.percentile(depths, [2, 98]).tolist()
    return low, max(high, low + 1e-6)


def colorize_depth(depth: Float[ndarray, "*shape"], low: float, high: float) -> UInt8[ndarray, "*shape 3"]:
    """Maps depths to the inferno colormap: bright at `low` and nearer, dark at `high` and farther."""
    nearness = 1 - (depth - low) / max(high - low, 1e-9)
    gray = (nearness.clip(0, 1) * 255).astype(np.uint8).reshape(-1, 1)
    return np.ascontiguousarray(cv2.applyColorMap(gray, cv2.COLORMAP_INFERNO)[..., ::-1]).reshape(*depth.shape, 3)


def make_panel(images: list[UInt8[ndarray, "H W 3"]], caption: str) -> UInt8[ndarray, "H2 W2 3"]:
    """Puts images of one size side by side, with the caption on a strip below."""
    magnify = max(1, -(-MIN_PANEL_HEIGHT_PX // images[0].shape[0]))
    row = np.concatenate(images, axis=1).repeat(magnify, axis=0).repeat(magnify, axis=1)
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, 1
    ascii_caption = caption.encode("ascii", "replace").decode()  # OpenCV's fonts are ASCII only
    size, baseline = cv2.getTextSize(ascii_caption, font, 0.4, thickness)
    font_scale = min(0.4, 0.4 * (row.shape[1] - 8) / max(size[0], 1))
    strip = np.full((size[1] + baseline + 8, row.shape[1], 3), 24, np.uint8)
    cv2.putText(strip, ascii_caption, (4, size[1] + 4), font, font_scale, (235, 235, 235), thickness, cv2.LINE_AA)
    return np.concatenate([row, strip])


def make_result_panel(result: ViewResult, caption: str) -> UInt8[ndarray, "H2 W2 3"]:
    """Panel of truth, render, and depth (3D) or four times the error (2D), each at most `MAX_PANEL_WIDTH_PX` wide."""
    if result.depth is not None and result.opacity is not None:
        depth, opacity = result.depth.numpy(), result.opacity.numpy()
        colors = colorize_depth(depth, *depth_percentiles(depth[opacity > 0.5]))
        third = (colors * opacity.clip(0, 1)[..., None]).astype(np.uint8)
        names = "truth | render | depth"
    else:
        third = to_uint8(result.errors * 4)
        names = "truth | render | 4 x error"
    shown = [limit_width(image, MAX_PANEL_WIDTH_PX) for image in (to_uint8(result.truth), to_uint8(result.rgb), third)]
    return make_panel(shown, f"{names}    {caption}")


def limit_width(image: UInt8[ndarray, "H W 3"], width: int) -> UInt8[ndarray, "h w 3"]:
    """Downsamples an image to at most `width` pixels across."""
    if image.shape[1] <= width:
        return image
    return resize_area(image, width, max(1, round(image.shape[0] * width / image.shape[1])))


def downsample(values: Float[ndarray, "H W"]) -> Float[ndarray, "h w"]:
    """Downsamples values to at most `MAX_CHART_SIDE_PX` along either side."""
    height, width = values.shape
    size = fit_size(width, height, MAX_CHART_SIDE_PX)
    return values if size == (width, height) else cv2.resize(values, size, interpolation=cv2.INTER_AREA)


def write_png(path: Path, image: UInt8[ndarray, "H W 3"]) -> None:
    with atomic_write(path) as temporary:
        imageio.imwrite(temporary, image, compress_level=3)  # half the time of the default, a tenth more bytes


def write_animation(path: Path, frames: Iterable[UInt8[ndarray, "H W C"]], seconds: float) -> None:
    """Writes frames of one size as a looping GIF or WebP, streaming them.

    Args:
        path: a temporary file whose suffix selects the format.
        frames: at least one.
        seconds: duration of each frame.
    """
    images = map(Image.fromarray, frames)
    next(images).save(path, save_all=True, append_images=images, duration=1000 * seconds, loop=0, quality=90)


def encode_data_url(image: UInt8[ndarray, "H W 3"], kind: str) -> str:
    """Encodes an image as a data URL: "jpeg" (lossy), "png" or "webp" (lossless)."""
    options: dict[str, Any] = {"lossless": True} if kind == "webp" else {}
    packed = imageio.imwrite("<bytes>", image, extension=f".{kind}", **options)
    return f"data:image/{kind};base64,{base64.b64encode(packed).decode()}"
