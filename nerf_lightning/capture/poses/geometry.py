"""Rigid transforms, and projection through a lens."""

import cv2
import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras.lenses import undistort
from nerf_lightning.dataset.intrinsics import Intrinsics


def rotvec_to_matrix(rotation: Float[np.ndarray, "3"], translation: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Converts a rotation vector and a translation to [R t; 0 1]."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def invert_pose(matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """Inverts a rigid transform: [R t; 0 1]^-1 = [R^T -R^T t; 0 1]."""
    out = np.eye(4)
    out[:3, :3] = matrix[:3, :3].T
    out[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return out


def angle_between(a: Float[np.ndarray, "4 4"], b: Float[np.ndarray, "4 4"]) -> float:
    """Rotation angle between two poses, radians."""
    chord = np.linalg.norm(a[:3, :3] - b[:3, :3]) / np.sqrt(8)  # sin(angle / 2)
    return 2 * float(np.arcsin(min(1.0, chord)))


def apply_pose(matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "M 3"]) -> Float[np.ndarray, "M 3"]:
    """Applies a rigid transform to points."""
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def project_points(
    lens: Intrinsics, w2c: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 2"]:
    """Projects world points through a lens; pixel centers at +0.5."""
    camera_points = apply_pose(w2c, points)[:, None]
    pixels, _ = cv2.projectPoints(camera_points, np.zeros(3), np.zeros(3), lens.K, lens.opencv_distortion)
    return np.asarray(pixels).reshape(-1, 2)


def normalize_pixels(lens: Intrinsics, pixels: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
    """Undistorts pixels to normalized coordinates x / z, y / z in the camera frame."""
    coefficients = torch.tensor([lens.distortion], dtype=torch.float64)
    centered = (pixels - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    return undistort(torch.from_numpy(centered), coefficients).numpy()
