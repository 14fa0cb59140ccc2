"""Photo quality: blur, exposure, brightness and duplicates, relative to the scene's other photos."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.dataset.resize import fit_size, resize_area
from nerf_lightning.dataset.views import Views

COMPARISON_SIDE_PX = 400
"""Longest side at which photos are compared."""
SATURATED_LEVEL, BLACK_LEVEL = 252, 4
"""8-bit levels at or beyond which channels are clipped."""
MAX_CLIPPED_FRACTION = 0.1
"""Fraction of clipped pixels above the scene's median that makes a photo over- or under-exposed."""
MAX_BRIGHTNESS_DIFFERENCE = 0.25
"""Difference to the scene's median brightness, in [0, 1], that makes a photo too dark or too bright."""
MIN_SHARPNESS_RATIO, MIN_SHARPNESS_DEVIATIONS = 0.75, 3.0
"""A photo is blurred if its sharpness is below this fraction of the median and this many robust deviations below it."""
THUMBNAIL_PX, MAX_DUPLICATE_DIFFERENCE = 48, 10
"""Photos are duplicates if 99 % of their thumbnails' pixels differ by less than this many 8-bit levels."""


@dataclass
class PhotoQuality:
    """Quality measures and issues of one photo."""

    name: str
    split: str
    """"train" or "held out"."""
    preview: UInt8[np.ndarray, "h w 3"]
    """Downsampled, transparent parts in gray."""
    sharpness: float
    brightness: float
    """Mean, in [0, 1]."""
    overexposed: float
    """Fraction of pixels whose brightest channel is saturated."""
    underexposed: float
    """Fraction of black pixels."""
    number: int = 0
    """Number on the page."""
    issues: list[str] = field(default_factory=list)


def measure_photos(views: Views, split: str) -> list[PhotoQuality]:
    """Measures the quality of photos."""
    measured = []
    for view in range(len(views)):
        image = views.image(view).numpy()
        is_visible = np.ones(image.shape[:2], bool) if image.shape[2] == 3 else image[..., 3] > 127
        if views.valid_mask is not None:
            is_visible &= views.view_mask(view).numpy()
        rgb = np.where(is_visible[..., None], image[..., :3], 128).astype(np.uint8)
        preview = resize_area(rgb, *fit_size(rgb.shape[1], rgb.shape[0], COMPARISON_SIDE_PX))
        pixels = rgb[is_visible] if is_visible.any() else rgb.reshape(-1, 3)
        name = views.names[view] if views.names else f"{split} {view}"
        masks = pixels.max(1) >= SATURATED_LEVEL, pixels.max(1) <= BLACK_LEVEL
        over, under = (float(np.mean(mask)) for mask in masks)
        measured.append(PhotoQuality(name, split, preview, sharpness(rgb), float(pixels.mean() / 255), over, under))
    return measured


def sharpness(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """Sharpness: standard deviation of the Laplacian at a blur of 0.7 pixels, relative to that at 2 pixels.

    The ratio cancels content and exposure; the slight blur suppresses noise.
    """
    gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = (cv2.Laplacian(cv2.GaussianBlur(gray, (0, 0), sigma), cv2.CV_32F) for sigma in (0.7, 2.0))
    return float(fine.std() / max(float(coarse.std()), 1e-3))


def find_issues(photos: Sequence[PhotoQuality], has_plain_background: bool) -> None:
    """Appends the issues of each photo to it.

    Args:
        photos: all photos of a scene.
        has_plain_background: whether the background is plain and may be saturated.
    """
    sharpnesses = np.array([photo.sharpness for photo in photos])
    median_sharpness = float(np.median(sharpnesses))
    spread = 1.4826 * float(np.median(np.abs(sharpnesses - median_sharpness)))  # as a standard deviation
    min_sharpness = min(MIN_SHARPNESS_RATIO * median_sharpness, median_sharpness - MIN_SHARPNESS_DEVIATIONS * spread)
    brightness = float(np.median([photo.brightness for photo in photos]))
    sides, size = ("overexposed", "underexposed"), (THUMBNAIL_PX, THUMBNAIL_PX)
    median_fractions = {side: float(np.median([getattr(photo, side) for photo in photos])) for side in sides}
    thumbnails = [cv2.resize(photo.preview, size, interpolation=cv2.INTER_AREA) for photo in photos]
    stack = np.stack(thumbnails).astype(np.float32)
    for i, photo in enumerate(photos):
        if photo.sharpness < min_sharpness:
            photo.issues.append(f"blurred: sharpness {photo.sharpness / median_sharpness:.0%} of the others'")
        for side, word in (("overexposed", "over-exposed"), ("underexposed", "under-exposed")):
            fraction = getattr(photo, side)
            if fraction > median_fractions[side] + MAX_CLIPPED_FRACTION and not has_plain_background:
                photo.issues.append(f"{word}: {fraction:.0%} of its pixels are clipped")
        if abs(photo.brightness - brightness) > MAX_BRIGHTNESS_DIFFERENCE:
            word = "brighter" if photo.brightness > brightness else "darker"
            photo.issues.append(f"{word} than the others")
        if i:
            difference = np.percentile(np.abs(stack[:i] - stack[i]).max(3), 99, axis=(1, 2))
            if float(difference.min()) < MAX_DUPLICATE_DIFFERENCE:
                photo.issues.append(f"duplicate: nearly identical to {photos[int(difference.argmin())].name}")
