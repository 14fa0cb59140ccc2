"""A perspective lens with OpenCV distortion, and the pinhole camera that is left once the distortion is undone."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from nerf_lightning.dataset.resize import premultiplied


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one photo in pixels; pixel centres at +0.5."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3, in OpenCV's order."""

    @property
    def K(self) -> Float[np.ndarray, "3 3"]:
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])


@dataclass(frozen=True)
class Rectification:
    """How a photo of one lens becomes a pinhole photo of the same size."""

    K: Float[np.ndarray, "3 3"]
    """Of the pinhole photo; pixel centres at +0.5."""
    col: Float[np.ndarray, "H W"] | None = None
    """Where each pixel comes from in the distorted photo, in OpenCV's indices (centres at integers); None: from itself."""
    row: Float[np.ndarray, "H W"] | None = None

    def apply(self, image: UInt8[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "H W C"]:
        if self.col is None or self.row is None:
            return image
        # The border is cropped away already; replicating keeps rounding at the very edge from painting it black.
        col, row = self.col, self.row
        return premultiplied(image, lambda x: cv2.remap(x, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


# OpenCV puts pixel centres at integers, we put them at +0.5.
_HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def rectify(lens: Lens) -> Rectification:
    """Undoes the distortion and zooms in just so far that no border without a source pixel is left."""
    if not any(lens.distortion):
        return Rectification(lens.K)
    size = (lens.width, lens.height)
    K = lens.K - _HALF
    distortion = np.array(lens.distortion)
    pinhole, _ = cv2.getOptimalNewCameraMatrix(K, distortion, size, 0, size)
    col, row = cv2.initUndistortRectifyMap(K, distortion, None, pinhole, size, cv2.CV_32FC1)
    return Rectification(pinhole + _HALF, col, row)
