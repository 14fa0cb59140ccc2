"""Depth as colour: near bright, far dark."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray


def depth_limits(depths: Float[ndarray, "*shape"]) -> tuple[float, float]:
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
