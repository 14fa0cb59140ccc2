"""Area-average resizing, also of pictures with alpha."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError


def fit_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Width and height with the longest side at `longest` pixels; never larger than before, and as before for None."""
    if longest is None:
        return width, height
    if longest < 1:
        raise InputError("resize", "", str(longest), "the longest side in pixels, at least 1")
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def premultiplied(
    image: UInt8[np.ndarray, "H W C"], operation: Callable[[np.ndarray], np.ndarray]
) -> UInt8[np.ndarray, "h w C"]:
    """Applies a linear filter to RGB as it is, to RGBA with premultiplied alpha.

    Straight colours under alpha 0 are arbitrary, mostly black: averaging them would give objects a dark rim.
    """
    if image.shape[2] == 3:
        return operation(image)
    image = image.astype(np.float32)
    image[..., :3] *= image[..., 3:] / 255
    image = operation(image)
    image[..., :3] /= np.maximum(image[..., 3:] / 255, 1e-6)
    return np.rint(image).clip(0, 255).astype(np.uint8)


def area_resize(image: UInt8[np.ndarray, "H W C"], width: int, height: int) -> UInt8[np.ndarray, "h w C"]:
    if image.shape[:2] == (height, width):
        return image
    return premultiplied(image, lambda x: cv2.resize(x, (width, height), interpolation=cv2.INTER_AREA))


def resize_views(views: Views, longest: int | None) -> Views:
    """Views without masks on smaller pixel grids."""
    cameras = views.cameras
    sizes = torch.tensor([fit_size(width, height, longest) for width, height in cameras.sizes.tolist()])
    if torch.equal(sizes, cameras.sizes):
        return views
    images = [area_resize(views.image(i).numpy(), *size) for i, size in enumerate(sizes.tolist())]
    pixels = np.concatenate([image.reshape(-1, views.channels) for image in images])
    return Views(torch.from_numpy(pixels), cameras.resized(sizes))
