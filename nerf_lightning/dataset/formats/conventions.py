"""The camera frames other tools use, told once; everything after a loader is OpenCV."""

import numpy as np
from jaxtyping import Float


def opengl_to_opencv(c2w: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, "V 4 4"]:
    """Camera to world from OpenGL's camera frame (x right, y up, z backward) to OpenCV's (y down, z forward)."""
    return c2w * np.array([1.0, -1.0, -1.0, 1.0])
