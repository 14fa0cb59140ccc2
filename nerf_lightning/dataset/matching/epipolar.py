"""Epipolar inlier ratio of matches between photos, for given cameras, on the unit sphere of directions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Cameras, Projection, pixel_to_camera
from nerf_lightning.cameras.lenses import normalized_to_directions, undistort
from nerf_lightning.dataset.matching.features import Pair

MAX_PAIR_MATCHES = 60
MATCH_TOLERANCE, MIN_TOLERANCE_PX, DISPLACEMENT_TOLERANCE = 0.012, 1.0, 0.3
"""Epipolar tolerance relative to the longest side, its minimum in pixels, and its maximum relative to the pair's
displacement."""
MIN_DEPTH_BASELINES = 0.5
"""Minimum depth of a match, in baselines."""


@dataclass(frozen=True)
class Matches:
    """M matches of P photo pairs, as directions in camera frames."""

    views: Int[np.ndarray, "P 2"]
    """Photos of each pair."""
    pair: Int[np.ndarray, "M"]
    """Pair of each match."""
    first: Float[np.ndarray, "M 3"]
    second: Float[np.ndarray, "M 3"]
    """Unit directions in the two cameras' frames."""
    tolerance: Float[np.ndarray, "M"]
    """Radians at the center of the second photo."""
    fisheye: Bool[np.ndarray, "M"]

    @classmethod
    def from_pairs(cls, pairs: Sequence[Pair], cameras: Cameras) -> "Matches":
        subsets = [pair.keypoints[:: -(-len(pair.keypoints) // MAX_PAIR_MATCHES)] for pair in pairs]
        index = np.repeat(np.arange(len(pairs)), [len(keypoints) for keypoints in subsets])
        keypoints = torch.from_numpy(np.concatenate(subsets)).float()
        views = np.array([(pair.first, pair.second) for pair in pairs])
        first, second = (unproject(cameras, views[index, side], keypoints[:, side]) for side in (0, 1))
        longest, focal = (x.double().numpy()[views[:, 1]] for x in (cameras.sizes.amax(1), cameras.K[:, 0, 0]))
        max_tolerance = DISPLACEMENT_TOLERANCE * np.array([pair.displacement for pair in pairs])
        tolerance = np.minimum((MATCH_TOLERANCE * longest).clip(MIN_TOLERANCE_PX), max_tolerance) / focal
        fisheye = np.zeros(len(cameras), bool)
        if cameras.lenses is not None:
            fisheye = (cameras.lenses.projection == Projection.FISHEYE).numpy()
        return cls(views, index, first, second, tolerance[index], fisheye[views[index, 1]])


def unproject(
    cameras: Cameras, view: Int[np.ndarray, "M"], keypoints: Float[Tensor, "M 2"]
) -> Float[np.ndarray, "M 3"]:
    """Unprojects pixels to unit directions in the camera frame."""
    index = torch.from_numpy(view)
    local = pixel_to_camera(cameras.K[index], keypoints, torch.ones(len(keypoints)))
    if cameras.lenses is not None:
        lenses = cameras.lenses[index]
        local = normalized_to_directions(undistort(local[:, :2], lenses.coefficients), lenses.projection)
    return torch.nn.functional.normalize(local, dim=1).double().numpy()


def find_inliers(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoom: float = 1.0, tolerance: float = 1.0
) -> Bool[np.ndarray, "M"]:
    """Mask of epipolar inliers: matches of a point in front of both cameras, at least `MIN_DEPTH_BASELINES` deep.

    As its depth varies, a point of the first photo draws an arc of a great circle around the second camera (a single
    direction for coincident cameras). The angle between that arc and the second direction must be within the tolerance.

    Args:
        matches: of pairs of photos.
        c2w: poses of all photos, OpenCV.
        zoom: factor on all focal lengths.
        tolerance: factor on the tolerance of each match.
    """
    cameras = c2w[matches.views]
    w2c = cameras[:, 1, :3, :3].transpose(0, 2, 1)
    rotation, baseline = w2c @ cameras[:, 0, :3, :3], w2c @ (cameras[:, 0, :3, 3:] - cameras[:, 1, :3, 3:])
    first, second = (_unit(x * [1, 1, zoom]) for x in (matches.first, matches.second))
    far = (rotation[matches.pair] @ first[..., None])[..., 0]
    near = _unit(MIN_DEPTH_BASELINES * far + _unit(baseline[:, :, 0])[matches.pair])
    normal = _unit(np.cross(far, near))
    is_between = (np.cross(far, second) * normal).sum(1) >= 0
    is_between &= (np.cross(second, near) * normal).sum(1) >= 0
    arc_distance = np.arcsin(np.abs((second * normal).sum(1)).clip(0, 1))
    ends = np.minimum(*(2 * np.arcsin(np.linalg.norm(end - second, axis=1).clip(0, 2) / 2) for end in (far, near)))
    # Pixels far from a pinhole camera's axis subtend smaller angles.
    pixel = np.where(matches.fisheye, 1.0, second[:, 2] ** 2) / zoom * tolerance
    return np.where(is_between & (normal != 0).any(1), arc_distance, ends) <= matches.tolerance * pixel


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Normalizes vectors; zero stays zero."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / length.clip(1e-9), 0.0)


def compute_inlier_ratio(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoom: float = 1.0, tolerance: float = 1.0
) -> float:
    """Computes the fraction of epipolar inliers, see `find_inliers`."""
    return float(find_inliers(matches, c2w, zoom, tolerance).mean())
