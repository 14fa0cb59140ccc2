"""Area-average resizing, also of pictures with alpha."""

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from nerf_lightning.dataset.views import Views


def fit_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Width and height with the longest side at `longest` pixels; never larger than before, and as before for None."""
    if longest is None:
        return width, height
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def area_resize(image: UInt8[np.ndarray, "H W C"], width: int, height: int) -> UInt8[np.ndarray, "h w C"]:
    """RGB as it is, RGBA with premultiplied alpha: straight colours under alpha 0 are arbitrary, mostly black, and would give
    objects a dark rim."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[2] == 3:
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    large = image.astype(np.float32)
    large[..., :3] *= large[..., 3:] / 255
    rgba = np.asarray(cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    rgba[..., :3] /= np.maximum(rgba[..., 3:] / 255, 1e-6)
    return np.rint(rgba).clip(0, 255).astype(np.uint8)


def resize_views(views: Views, longest: int | None) -> Views:
    """Views without masks on smaller pixel grids."""
    cameras = views.cameras
    sizes = torch.tensor([fit_size(width, height, longest) for width, height in cameras.sizes.tolist()])
    if torch.equal(sizes, cameras.sizes):
        return views
    images = [area_resize(views.image(i).numpy(), *size) for i, size in enumerate(sizes.tolist())]
    pixels = np.concatenate([image.reshape(-1, views.channels) for image in images])
    return Views(torch.from_numpy(pixels), cameras.resized(sizes))
