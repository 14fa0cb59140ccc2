"""Rigid motions as six numbers, and projection through a lens."""

import cv2
import numpy as np
from jaxtyping import Float

from nerf_lightning.dataset.intrinsics import Intrinsics


def to_matrix(vector: Float[np.ndarray, "6"]) -> Float[np.ndarray, "4 4"]:
    """Rotation vector and translation to [R t; 0 1]."""
    matrix = np.eye(4)
    matrix[:3, :3] = cv2.Rodrigues(vector[:3])[0]
    matrix[:3, 3] = vector[3:]
    return matrix


def to_vector(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "6"]:
    """[R t; 0 1] to rotation vector and translation."""
    return np.concatenate([cv2.Rodrigues(matrix[:3, :3])[0].reshape(3), matrix[:3, 3]])


def inverse(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """[R t; 0 1]^-1 = [R^T -R^T t; 0 1]."""
    out = np.eye(4)
    out[:3, :3] = matrix[:3, :3].T
    out[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return out


def angle_between(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> float:
    """Angle of the rotation from one motion to the other, radians."""
    relative = a[:3, :3].T @ b[:3, :3]
    # The chord is exact at small angles, where the cosine is not.
    return 2 * float(np.arcsin(min(1.0, np.linalg.norm(relative - np.eye(3)) / np.sqrt(8))))


def move(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """Points after a rigid motion."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def project(
    lens: Intrinsics, w2c: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 2"]:
    """Where a photo shows points of the world; pixel centres at +0.5, as in `lens`."""
    vector = to_vector(w2c)
    pixels, _ = cv2.projectPoints(points.reshape(-1, 1, 3), vector[:3], vector[3:], lens.K, lens.opencv)
    return np.asarray(pixels).reshape(-1, 2)


def folds(lens: Intrinsics) -> bool:
    """Whether the radial distortion turns back before the picture's farthest corner, so that two directions share a pixel.

    No lens does that, but a polynomial fitted only to the middle of the picture may.
    """
    k1, k2, _, _, k3 = lens.opencv
    x, y = max(lens.cx, lens.width - lens.cx) / lens.fx, max(lens.cy, lens.height - lens.cy) / lens.fy
    r = np.linspace(0, 4, 4001)
    distorted = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
    turns = np.flatnonzero(np.diff(distorted) <= 0)
    reached = np.flatnonzero(distorted >= np.hypot(x, y))
    return not len(reached) or bool(len(turns) and turns[0] < reached[0])


def normalised(lens: Intrinsics, pixels: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    """Pixels as tangents x / z, y / z in the camera frame, the lens's distortion undone."""
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
    undistort = getattr(cv2, "undistortPointsIter", None)  # OpenCV 4 took the criteria under another name
    given = pixels.reshape(-1, 1, 2), lens.K, lens.opencv
    if undistort is not None:
        return np.asarray(undistort(*given, None, None, stop)).reshape(-1, 2)
    return np.asarray(cv2.undistortPoints(*given, None, None, None, stop)).reshape(-1, 2)
