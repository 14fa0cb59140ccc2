"""Pictures for people: panels side by side with a caption under them."""

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
"""Panels below this height are magnified (whole multiples, hard edges), so that the caption stays readable."""
MAX_CHART_SIDE_PX = 2048
"""Pixels across of a chart's picture."""
MAX_PANEL_WIDTH_PX = 1024
"""Pixels across of a picture that stands beside others: a run keeps dozens, and `final.png` is whole."""


def to_uint8(image: Float[Tensor, "*shape"]) -> UInt8[ndarray, "*shape"]:
    """[0, 1] -> bytes, rounded, on the CPU."""
    return image.clamp(0, 1).mul_(255).round_().byte().cpu().numpy()


def depth_percentiles(depths: Float[ndarray, "*shape"]) -> tuple[float, float]:
    """The 2nd and the 98th percentile of depths; 0 and 1 where there are none."""
    if not depths.size:
        return 0.0, 1.0
    low, high = np.percentile(depths, [2, 98]).tolist()
    return low, max(high, low + 1e-6)


def colorize_depth(depth: Float[ndarray, "*shape"], low: float, high: float) -> UInt8[ndarray, "*shape 3"]:
    """Depths on a perceptually uniform scale (inferno): bright at `low` and nearer, dark at `high` and farther."""
    nearness = 1 - (depth - low) / max(high - low, 1e-9)
    grey = (nearness.clip(0, 1) * 255).astype(np.uint8).reshape(-1, 1)
    return np.ascontiguousarray(cv2.applyColorMap(grey, cv2.COLORMAP_INFERNO)[..., ::-1]).reshape(*depth.shape, 3)


def make_panel(images: list[UInt8[ndarray, "H W 3"]], caption: str) -> UInt8[ndarray, "H2 W2 3"]:
    """Images of one size side by side, the caption on a strip below."""
    magnify = max(1, -(-MIN_PANEL_HEIGHT_PX // images[0].shape[0]))
    row = np.concatenate(images, axis=1).repeat(magnify, axis=0).repeat(magnify, axis=1)
    font, thickness = cv2.FONT_HERSHEY_SIMPLEX, 1
    plain = caption.encode("ascii", "replace").decode()  # OpenCV's fonts have no other letters
    size, below = cv2.getTextSize(plain, font, 0.4, thickness)
    fit = min(0.4, 0.4 * (row.shape[1] - 8) / max(size[0], 1))
    strip = np.full((size[1] + below + 8, row.shape[1], 3), 24, np.uint8)
    cv2.putText(strip, plain, (4, size[1] + 4), font, fit, (235, 235, 235), thickness, cv2.LINE_AA)
    return np.concatenate([row, strip])


def make_result_panel(result: ViewResult, caption: str) -> UInt8[ndarray, "H2 W2 3"]:
    """Truth, render, and depth (3D) or error times four (2D), each at most `MAX_PANEL_WIDTH_PX` pixels across."""
    if result.depth is not None and result.opacity is not None:
        depth, opacity = result.depth.numpy(), result.opacity.numpy()
        colours = colorize_depth(depth, *depth_percentiles(depth[opacity > 0.5]))
        third = (colours * opacity.clip(0, 1)[..., None]).astype(np.uint8)
        names = "truth | render | depth"
    else:
        third = to_uint8(result.errors * 4)
        names = "truth | render | 4 x error"
    shown = [limit_width(one, MAX_PANEL_WIDTH_PX) for one in (to_uint8(result.truth), to_uint8(result.rgb), third)]
    return make_panel(shown, f"{names}    {caption}")


def limit_width(image: UInt8[ndarray, "H W 3"], width: int) -> UInt8[ndarray, "h w 3"]:
    """Averaged down to at most `width` pixels across."""
    if image.shape[1] <= width:
        return image
    return resize_area(image, width, max(1, round(image.shape[0] * width / image.shape[1])))


def downsample(values: Float[ndarray, "H W"]) -> Float[ndarray, "h w"]:
    """Averaged down to at most `MAX_CHART_SIDE_PX` along either side, of which a chart shows no more."""
    height, width = values.shape
    size = fit_size(width, height, MAX_CHART_SIDE_PX)
    return values if size == (width, height) else cv2.resize(values, size, interpolation=cv2.INTER_AREA)


def write_png(path: Path, image: UInt8[ndarray, "H W 3"]) -> None:
    with atomic_write(path) as temporary:
        imageio.imwrite(temporary, image, compress_level=3)  # half the time of the default, a tenth more bytes


def write_animation(path: Path, frames: Iterable[UInt8[ndarray, "H W C"]], seconds: float) -> None:
    """Frames of one size -> GIF or WebP that begins again and again, into a file that the caller renames.

    Of a GIF no more than a byte a pixel is kept: its frames may be drawn while it is written.

    Args:
        path: its suffix says which.
        frames: at least one.
        seconds: that each is shown.
    """
    images = map(Image.fromarray, frames)
    next(images).save(path, save_all=True, append_images=images, duration=1000 * seconds, loop=0, quality=90)


def encode_data_url(image: UInt8[ndarray, "H W 3"], kind: str) -> str:
    """An image as text: "jpeg" with loss, "png" or "webp" without."""
    options: dict[str, Any] = {"lossless": True} if kind == "webp" else {}
    packed = imageio.imwrite("<bytes>", image, extension=f".{kind}", **options)
    return f"data:image/{kind};base64,{base64.b64encode(packed).decode()}"
