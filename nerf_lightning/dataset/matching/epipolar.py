"""How much of the matches between photos cameras explain, by epipolar geometry on the sphere of directions."""

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
"""Of a pair: more would not tell more."""
MATCH_TOLERANCE, MIN_TOLERANCE_PX, DISPLACEMENT_TOLERANCE = 0.012, 1.0, 0.3
"""Distance of a match from where the cameras allow it, as a share of the longest side, its least in pixels, and its most as a
share of how far the pair's matches are displaced."""
MIN_DEPTH_BASELINES = 0.5
"""Of what photos show, in distances between the two cameras."""


@dataclass(frozen=True)
class Matches:
    """The matches of P pairs of photos, M in all, as directions in their cameras' frames."""

    views: Int[np.ndarray, "P 2"]
    """Of each pair."""
    pair: Int[np.ndarray, "M"]
    """That each match is of."""
    first: Float[np.ndarray, "M 3"]
    second: Float[np.ndarray, "M 3"]
    """Unit directions in the two cameras' frames."""
    tolerance: Float[np.ndarray, "M"]
    """Radians at the second photo's middle."""
    fisheye: Bool[np.ndarray, "M"]

    @classmethod
    def from_pairs(cls, pairs: Sequence[Pair], cameras: Cameras) -> "Matches":
        some = [one.keypoints[:: -(-len(one.keypoints) // MAX_PAIR_MATCHES)] for one in pairs]
        pair = np.repeat(np.arange(len(pairs)), [len(keypoints) for keypoints in some])
        keypoints = torch.from_numpy(np.concatenate(some)).float()
        views = np.array([(one.first, one.second) for one in pairs])
        first, second = (unproject(cameras, views[pair, side], keypoints[:, side]) for side in (0, 1))
        longest, focal = (x.double().numpy()[views[:, 1]] for x in (cameras.sizes.amax(1), cameras.K[:, 0, 0]))
        moved = np.array([one.displacement for one in pairs])
        tolerance = (
            np.minimum((MATCH_TOLERANCE * longest).clip(MIN_TOLERANCE_PX), DISPLACEMENT_TOLERANCE * moved) / focal
        )
        bent = np.zeros(len(cameras), bool)
        if cameras.lenses is not None:
            bent = (cameras.lenses.projection == Projection.FISHEYE).numpy()
        return cls(views, pair, first, second, tolerance[pair], bent[views[pair, 1]])


def unproject(
    cameras: Cameras, view: Int[np.ndarray, "M"], keypoints: Float[Tensor, "M 2"]
) -> Float[np.ndarray, "M 3"]:
    """Unit directions, camera frame, of places in photos, pixels."""
    index = torch.from_numpy(view)
    local = pixel_to_camera(cameras.K[index], keypoints, torch.ones(len(keypoints)))
    if cameras.lenses is not None:
        lenses = cameras.lenses[index]
        local = normalized_to_directions(undistort(local[:, :2], lenses.coefficients), lenses.projection)
    return torch.nn.functional.normalize(local, dim=1).double().numpy()


def find_inliers(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoom: float = 1.0, tolerance: float = 1.0
) -> Bool[np.ndarray, "M"]:
    """Which matches cameras allow: something before both, no nearer than `MIN_DEPTH_BASELINES`, would appear in both places.

    What the first photo shows at one place draws an arc of a great circle around the second camera as its depth varies; cameras
    on one spot see it in one direction. The angle between that arc and where the second photo shows it must be small.
    """
    cameras = c2w[matches.views]
    back = cameras[:, 1, :3, :3].transpose(0, 2, 1)
    turn, shift = back @ cameras[:, 0, :3, :3], back @ (cameras[:, 0, :3, 3:] - cameras[:, 1, :3, 3:])
    first, second = (_unit(x * [1, 1, zoom]) for x in (matches.first, matches.second))
    farthest = (turn[matches.pair] @ first[..., None])[..., 0]
    nearest = _unit(MIN_DEPTH_BASELINES * farthest + _unit(shift[:, :, 0])[matches.pair])
    normal = _unit(np.cross(farthest, nearest))
    is_between = (np.cross(farthest, second) * normal).sum(1) >= 0
    is_between &= (np.cross(second, nearest) * normal).sum(1) >= 0
    arc_distance = np.arcsin(np.abs((second * normal).sum(1)).clip(0, 1))
    ends = np.minimum(
        *(2 * np.arcsin(np.linalg.norm(end - second, axis=1).clip(0, 2) / 2) for end in (farthest, nearest))
    )
    # A pixel far from a pinhole camera's axis shows a smaller angle.
    pixel = np.where(matches.fisheye, 1.0, second[:, 2] ** 2) / zoom * tolerance
    return np.where(is_between & (normal != 0).any(1), arc_distance, ends) <= matches.tolerance * pixel


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Of length 1, or 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / length.clip(1e-9), 0.0)


def compute_inlier_ratio(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoom: float = 1.0, tolerance: float = 1.0
) -> float:
    """Share of the matches that cameras allow, see `find_inliers`."""
    return float(find_inliers(matches, c2w, zoom, tolerance).mean())
