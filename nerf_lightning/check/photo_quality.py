"""What is wrong with a photo, judged against the others of its scene."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import UInt8

from nerf_lightning.dataset.resize import fit_size, resize_area
from nerf_lightning.dataset.views import Views

COMPARISON_SIDE_PX = 400
"""Longest side in pixels at which photos are compared."""
SATURATED_LEVEL, BLACK_LEVEL = 252, 4
"""In 1/255: channels at or beyond these have lost what was there."""
MAX_LOST_FRACTION = 0.1
"""Share of a photo beyond them, above its scene's median, that makes it over- or under-exposed."""
MAX_BRIGHTNESS_DIFFERENCE = 0.25
"""Difference of mean brightness to the median photo's, in [0, 1], that makes a photo too dark or too bright."""
MIN_SHARPNESS_RATIO, MIN_SHARPNESS_DEVIATIONS = 0.75, 3.0
"""A photo is blurred where its sharpness is below that share of the median and that many spreads below it."""
THUMBNAIL_PX, MAX_DUPLICATE_DIFFERENCE = 48, 10
"""Two photos are one where all but 1 % of their thumbnails' pixels differ by less than that, in 1/255."""


@dataclass
class PhotoQuality:
    """One photo and what is known of it."""

    name: str
    split: str
    """"train" or "held out"."""
    preview: UInt8[np.ndarray, "h w 3"]
    """Reduced, transparent parts on grey."""
    sharpness: float
    brightness: float
    """Mean, in [0, 1]."""
    overexposed: float
    """Share of pixels whose brightest channel is saturated."""
    underexposed: float
    """Share of pixels that are black."""
    number: int = 0
    """On the page."""
    issues: list[str] = field(default_factory=list)


def measure_photos(views: Views, split: str) -> list[PhotoQuality]:
    """Measures photos."""
    measured = []
    for view in range(len(views)):
        image = views.image(view).numpy()
        shown = np.ones(image.shape[:2], bool) if image.shape[2] == 3 else image[..., 3] > 127
        if views.valid_mask is not None:
            shown &= views.view_mask(view).numpy()
        rgb = np.where(shown[..., None], image[..., :3], 128).astype(np.uint8)
        preview = resize_area(rgb, *fit_size(rgb.shape[1], rgb.shape[0], COMPARISON_SIDE_PX))
        pixels = rgb[shown] if shown.any() else rgb.reshape(-1, 3)
        name = views.names[view] if views.names else f"{split} {view}"
        overexposed, underexposed = (
            float(np.mean(mask)) for mask in (pixels.max(1) >= SATURATED_LEVEL, pixels.max(1) <= BLACK_LEVEL)
        )
        measured.append(
            PhotoQuality(name, split, preview, sharpness(rgb), float(pixels.mean() / 255), overexposed, underexposed)
        )
    return measured


def sharpness(image: UInt8[np.ndarray, "H W 3"]) -> float:
    """How much of a photo's detail is fine: the spread of its second derivatives against that of the photo blurred by 2 pixels.

    A ratio, so that content and exposure matter little. Noise is taken off first by a slight blur.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine, coarse = (cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), sigma), cv2.CV_32F) for sigma in (0.7, 2.0))
    return float(fine.std() / max(float(coarse.std()), 1e-3))


def find_issues(photos: Sequence[PhotoQuality], has_plain_background: bool) -> None:
    """Notes the troubles of each photo.

    Args:
        photos: all of a scene.
        has_plain_background: whether they stand before a plain background, which may be saturated.
    """
    sharp = np.array([photo.sharpness for photo in photos])
    usual_sharpness = float(np.median(sharp))
    spread = 1.4826 * float(np.median(np.abs(sharp - usual_sharpness)))  # as a standard deviation
    brightness = float(np.median([photo.brightness for photo in photos]))
    usual = {
        side: float(np.median([getattr(photo, side) for photo in photos])) for side in ("overexposed", "underexposed")
    }
    thumbs = np.stack(
        [cv2.resize(p.preview, (THUMBNAIL_PX, THUMBNAIL_PX), interpolation=cv2.INTER_AREA) for p in photos]
    ).astype(np.float32)
    for i, photo in enumerate(photos):
        if photo.sharpness < min(
            MIN_SHARPNESS_RATIO * usual_sharpness, usual_sharpness - MIN_SHARPNESS_DEVIATIONS * spread
        ):
            photo.issues.append(f"blurred: sharpness {photo.sharpness / usual_sharpness:.0%} of the others'")
        for side, word in (("overexposed", "over-exposed"), ("underexposed", "under-exposed")):
            fraction = getattr(photo, side)
            if fraction > usual[side] + MAX_LOST_FRACTION and not has_plain_background:
                photo.issues.append(f"{word}: {fraction:.0%} of it has no detail left")
        if abs(photo.brightness - brightness) > MAX_BRIGHTNESS_DIFFERENCE:
            word = "brighter" if photo.brightness > brightness else "darker"
            photo.issues.append(f"{word} than the others")
        if i:
            difference = np.percentile(np.abs(thumbs[:i] - thumbs[i]).max(3), 99, axis=(1, 2))
            if float(difference.min()) < MAX_DUPLICATE_DIFFERENCE:
                photo.issues.append(f"doubled: it shows what {photos[int(difference.argmin())].name} shows")
