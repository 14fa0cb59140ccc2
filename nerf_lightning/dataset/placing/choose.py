"""Which frames of a video to take: the sharpest of each stretch of motion."""

import math

import cv2
import numpy as np
from jaxtyping import Float, UInt8

MOST = 120
"""Frames that are taken of a video if nobody says how many: one for every three degrees of a full turn."""
STEP = 0.01
"""Motion between two frames that are worth taking both, as a share of the picture's longest side; likewise."""
CHOICE = 3
"""Frames in a stretch, at the least: that the sharpest is no blurred one, though every third is."""
FEWEST = 3
"""Frames of which a scene can be made."""
SLOW = 1 / 8
"""Of the mean motion: where there is less, the camera counts as standing still."""
STILL = 0.05
"""Motion in pixels of the small pictures that noise and compression make up where nothing moves."""
ALIKE = 0.03
"""Difference in sharpness (3 % of the fine detail) up to which frames are equally sharp: noise makes up as much."""
FINE, COARSE = 1.0, 3.0
"""Standard deviations in pixels of the Gaussians that bring out the two scales of detail; the first takes noise away."""


def motion(before: UInt8[np.ndarray, "h w"], after: UInt8[np.ndarray, "h w"]) -> float:
    """How far the content of two small pictures is shifted, as a share of their longest side.

    The mean length of dense optical flow (Kroeger et al. 2016), weighted by contrast: plain areas show no motion.
    """
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_FAST).calc(before, after, None)  # type: ignore[call-overload]
    lengths = np.linalg.norm(flow, axis=-1)
    x, y = (cv2.Sobel(before, cv2.CV_32F, *order) for order in ((1, 0), (0, 1)))
    contrast = np.hypot(x, y)
    pixels = float((lengths * contrast).sum() / max(float(contrast.sum()), 1e-6))
    return max(0.0, pixels - STILL) / max(before.shape)


def sharpness(picture: UInt8[np.ndarray, "H W"]) -> float:
    """Logarithm of a picture's fine detail over its coarse detail: variances of the Laplacian at two scales.

    Neither exposure nor contrast changes it, and blur takes away the fine detail first. It does depend on what a picture
    shows, so that only pictures of nearly the same can be compared.
    """
    pixels = picture.astype(np.float32)
    fine, coarse = (
        cv2.Laplacian(cv2.GaussianBlur(pixels, (0, 0), sigma), cv2.CV_32F).var() for sigma in (FINE, COARSE)
    )
    return math.log((float(fine) + 1e-6) / (float(coarse) + 1e-6))


def suitable_count(motions: Float[np.ndarray, "N"]) -> int:
    """How many frames to take of a video, from the motion that leads to each of its frames."""
    moving = 1 + int(np.count_nonzero(motions > SLOW * motions.mean()))
    return max(FEWEST, min(MOST, moving // CHOICE, math.ceil(float(motions.sum()) / STEP)))


def choose(motions: Float[np.ndarray, "N"], sharp: Float[np.ndarray, "N"], count: int) -> list[int]:
    """Divides a video into stretches of equal motion and takes the sharpest frame of each, compared with those around it.

    Of equally sharp frames it is the one nearest to the stretch's middle. Where the camera moves fast a stretch holds
    `CHOICE` frames nevertheless, if there are enough that show motion.

    Args:
        motions: that lead to each frame.
        sharp: `sharpness` of each.
        count: how many to take, at most as many as there are frames.

    Returns:
        Indices in order.
    """
    # Frames where nothing moves count a little, so that a video of a still scene can be divided too.
    steps = motions + 1e-6 * max(float(motions.sum()), 1.0) / len(motions)
    capped = steps
    for _ in range(100):
        capped = np.minimum(steps, max(capped.sum() / (CHOICE * count), SLOW * steps.mean()))
    path = np.cumsum(capped)
    place = count * (path - capped / 2) / path[-1]  # of each frame's middle, in stretches
    around = max(4, round(len(motions) / count))
    relative = sharp - _middle(sharp, around)
    chosen = []
    for number in range(count):
        (within,) = np.nonzero(place.astype(int) == number)
        if len(within):
            sharpest = within[relative[within] >= relative[within].max() - ALIKE]
            chosen.append(int(sharpest[np.abs(place[sharpest] - number - 0.5).argmin()]))
    return chosen


def _middle(values: Float[np.ndarray, "N"], around: int) -> Float[np.ndarray, "N"]:
    """The median of each value and as many on either side."""
    return np.array([np.median(values[max(0, i - around) : i + around + 1]) for i in range(len(values))])
