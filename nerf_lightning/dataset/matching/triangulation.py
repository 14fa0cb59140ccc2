"""Triangulation of SIFT matches between photos of known pose."""

import logging
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset.matching.epipolar import unproject
from nerf_lightning.dataset.matching.features import detect_features, match_features
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.text import subsample

log = logging.getLogger(__name__)

MAX_PAIRS = 8
"""Matched pairs of photos."""
MIN_AXIS_COSINE = 0.85
"""Minimum cosine between the axes of matched photos."""
MAX_ERROR_PX, REFERENCE_SIDE_PX = 2.0, 640
"""Largest reprojection error of a point up to the reference side; larger for larger photos."""
MIN_PARALLAX_RAD = 0.005
"""Minimum triangulation angle; farther points are moved to the depth of that angle."""


def triangulate_matches(views: Views, c2w: Float[np.ndarray, "V 4 4"]) -> Float[Tensor, "M 3"]:
    """Triangulates matches between photos that look in nearly the same direction from different positions.

    Keeps points in front of both cameras. Points below `MIN_PARALLAX_RAD` get the largest measurable depth.

    Args:
        views: photos; the poses of their cameras are ignored.
        c2w: OpenCV camera to world, in the frame of the points.
    """
    local = torch.from_numpy(c2w).clone()
    origin = local[:, :3, 3].median(0).values
    local[:, :3, 3] -= origin
    cameras = replace(views.cameras, c2w=local.float())
    pairs = find_neighbors(local)
    parts = [torch.zeros(0, 3)]
    for pair in pairs:
        keypoints = match_features(*(detect_features(views, view) for view in pair))
        parts.append(triangulate(cameras[torch.tensor(pair)], torch.from_numpy(keypoints)))
    points = torch.cat(parts)
    log.info("triangulated %d points from %d pairs of photos", len(points), len(pairs))
    return points.double() + origin


def find_neighbors(c2w: Float[Tensor, "V 4 4"]) -> list[tuple[int, int]]:
    """Finds pairs spread over the capture: each view with the median-baseline one of similar direction."""
    axes, centers = normalize(c2w[:, :3, 2], dim=1), c2w[:, :3, 3]
    pairs = set()
    for view in subsample(len(c2w), MAX_PAIRS):
        cosine = axes @ axes[view]
        cosine[view] = -1
        others = (cosine >= min(MIN_AXIS_COSINE, float(cosine.max()))).nonzero()[:, 0]
        baseline = (centers[others] - centers[view]).norm(dim=1)
        other = int(others[baseline.argsort()[len(others) // 2]])
        if other != view:
            pairs.add((min(view, other), max(view, other)))
    return sorted(pairs)


def triangulate(cameras: Cameras, keypoints: Float[Tensor, "N 2 2"]) -> Float[Tensor, "M 3"]:
    """Triangulates keypoints of two cameras, in pixels; keeps points in front of both with a small reprojection error."""
    a, b = (
        torch.from_numpy(unproject(cameras, np.full(len(keypoints), view), keypoints[:, view].float()))
        @ cameras.c2w[view, :3, :3].double().T
        for view in (0, 1)
    )
    baseline = (cameras.centers[1] - cameras.centers[0]).double()
    # Least squares for s a - t b = baseline.
    sine = torch.linalg.cross(a, b).norm(dim=1)
    cosine = (a * b).sum(1)
    s = ((a - cosine[:, None] * b) @ baseline) / sine.square().clamp_min(1e-12)
    t = ((cosine[:, None] * a - b) @ baseline) / sine.square().clamp_min(1e-12)
    farthest = float(baseline.norm()) / MIN_PARALLAX_RAD
    is_far = (sine < MIN_PARALLAX_RAD) | (s <= 0) | (t <= 0) | (s > farthest)
    points = cameras.centers[0].double() + torch.where(is_far, farthest, s)[:, None] * a
    kept = torch.ones(len(points), dtype=torch.bool)
    for view in (0, 1):
        pixels, _, visible = cameras.project(points.float(), view)
        error = (pixels.double() - keypoints[:, view]).norm(dim=1)
        kept &= visible & (error < MAX_ERROR_PX * max(1.0, max(cameras.size(view)) / REFERENCE_SIDE_PX))
    return points[kept].float()
