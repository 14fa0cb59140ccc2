"""SIFT features of photos, and matches between them."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from nerf_lightning.cameras import Cameras
from nerf_lightning.dataset.views import Views
from nerf_lightning.utils.text import subsample

MAX_SIDE_PX, MIN_SIDE_PX, MAX_ENLARGEMENT = 320, 256, 3
"""Longest side for feature detection: larger photos are reduced, smaller ones enlarged by at most the last."""
MAX_FEATURES, MAX_COARSE_FEATURES = 400, 128
"""Features per photo, and those used to find overlapping photos."""
FEATURE_DIM = 128 + 3
MAX_RATIO = 0.8
"""Lowe's ratio test: largest distance of a match relative to the second-best (Lowe 2004, section 7.1)."""
MIN_COARSE_MATCHES, MIN_MATCHES = 5, 8
"""Minimum matches of the strongest features to match two photos, and of all features to keep the pair."""
PARTNERS_BY_PHOTO, PARTNERS_BY_POSE = 3, 2
"""Photos that each is matched with: by number of coarse matches, and by camera distance."""
MAX_PAIRS = 120
MIN_DISPLACEMENT = 0.02
"""Minimum median displacement of a pair, relative to the longest side: smaller ones fit nearly any camera."""
EPIPOLAR_TOLERANCE, MAX_ITERATIONS = 0.004, 500
"""RANSAC threshold for the fundamental matrix, relative to the longest side, and iterations."""


@dataclass(frozen=True)
class Features:
    """Keypoints and descriptors of a photo, strongest first."""

    keypoints: Float[np.ndarray, "F 2"]
    """Column and row, pixels of the photo; the first pixel's center is at 0.5."""
    descriptors: Float[Tensor, "F D"]
    """RootSIFT (Arandjelovic and Zisserman 2012) and sRGB in [0, 1], which distinguishes points that differ in color only."""


@dataclass(frozen=True)
class Pair:
    """Two photos and the putative matches between them."""

    first: int
    second: int
    keypoints: Float[np.ndarray, "M 2 2"]
    """Pixels of each match in the first and second photo."""

    @property
    def displacement(self) -> float:
        """Median displacement of the matches, pixels."""
        return float(np.median(np.linalg.norm(self.keypoints[:, 1] - self.keypoints[:, 0], axis=1)))


def detect_features(views: Views, view: int) -> Features:
    """Detects SIFT features in the unmasked and opaque parts of one photo."""
    image = views.image(view).numpy()
    visible = np.ones(image.shape[:2], bool) if views.valid_mask is None else views.view_mask(view).numpy()
    if image.shape[2] == 4:
        visible = visible & (image[..., 3] > 127)
    height, width = image.shape[:2]
    longest = max(height, width)
    scale = min(max(1.0, min(MIN_SIDE_PX / longest, MAX_ENLARGEMENT)), MAX_SIDE_PX / longest)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    colors = cv2.resize(np.ascontiguousarray(image[..., :3]), size, interpolation=method)
    mask = cv2.resize(visible.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    colors[mask == 0] = 127
    sift = cv2.SIFT.create(MAX_FEATURES, contrastThreshold=0.02)
    points, descriptors = sift.detectAndCompute(cv2.cvtColor(colors, cv2.COLOR_RGB2GRAY), mask)
    if descriptors is None or not len(points):
        return Features(np.zeros((0, 2)), torch.zeros(0, FEATURE_DIM))
    order = np.argsort([-point.response for point in points], kind="stable")[:MAX_FEATURES]
    keypoints = np.array([points[i].pt for i in order], np.float64) + 0.5
    root = np.sqrt(descriptors[order] / descriptors[order].sum(1, keepdims=True).clip(1e-6))
    column, row = keypoints.astype(int).clip(0, np.array(size) - 1).T
    color = cv2.GaussianBlur(colors, (0, 0), 2.0)[row, column] / 255
    rows = torch.from_numpy(np.hstack([root, color])).float()
    return Features(keypoints * [width / size[0], height / size[1]], rows)


def match_features(first: Features, second: Features) -> Float[np.ndarray, "M 2 2"]:
    """Matches mutual nearest neighbors that pass Lowe's ratio test."""
    if min(len(first.keypoints), len(second.keypoints)) < 2:
        return np.zeros((0, 2, 2))
    distance = torch.cdist(first.descriptors, second.descriptors)
    best, partner = distance.topk(2, dim=1, largest=False)
    index = torch.arange(len(distance))
    kept = (best[:, 0] < MAX_RATIO * best[:, 1]) & (distance.argmin(0)[partner[:, 0]] == index)
    return np.stack([first.keypoints[index[kept].numpy()], second.keypoints[partner[kept, 0].numpy()]], axis=1)


def count_matches(features: Sequence[Features]) -> Int[np.ndarray, "V V"]:
    """Counts the matches of the strongest features between all photos: the smaller of both directions."""
    table = torch.full((len(features), MAX_COARSE_FEATURES, FEATURE_DIM), 1e3)  # padding is far from all
    coarse = [x.descriptors[:MAX_COARSE_FEATURES] for x in features]
    for row, descriptors in zip(table, coarse, strict=True):
        row[: len(descriptors)] = descriptors
    nearest = [torch.cdist(descriptors, table).topk(2, dim=2, largest=False).values for descriptors in coarse]
    counts = torch.stack([(two[..., 0] < MAX_RATIO * two[..., 1]).sum(1) for two in nearest]).fill_diagonal_(0)
    return torch.minimum(counts, counts.T).numpy()


def find_pairs(features: Sequence[Features], cameras: Cameras) -> list[Pair]:
    """Matches photos that seem to overlap, by coarse matches or by similar poses."""
    counts = count_matches(features)
    by_photo = np.argsort(-counts, axis=1, kind="stable")[:, :PARTNERS_BY_PHOTO]
    centers, axes = cameras.centers, cameras.c2w[:, :3, 2]
    spread = (centers - centers.mean(0)).norm(dim=1).mean().clamp_min(1e-12)
    distance = (torch.cdist(centers, centers) / spread + torch.cdist(axes, axes)).numpy()
    by_pose = np.argsort(distance, axis=1, kind="stable")[:, 1 : 1 + PARTNERS_BY_POSE]
    candidates = set()
    for view in range(len(cameras)):
        partners = [*by_pose[view], *(i for i in by_photo[view] if counts[view, i] >= MIN_COARSE_MATCHES)]
        candidates |= {(min(view, int(other)), max(view, int(other))) for other in partners if other != view}
    ordered = sorted(candidates)
    pairs = []
    for first, second in (ordered[i] for i in subsample(len(ordered), MAX_PAIRS)):
        pair = Pair(first, second, match_features(features[first], features[second]))
        if len(pair.keypoints) >= MIN_MATCHES and pair.displacement >= MIN_DISPLACEMENT * max(cameras.size(first)):
            pairs.append(pair)
    return pairs


def compute_ransac_inlier_ratio(pairs: Sequence[Pair], longest: int) -> float:
    """Computes the fraction of RANSAC inliers of the pairs' fundamental matrices, independent of the cameras.

    Args:
        pairs: matched photos.
        longest: longest side of the photos, pixels.
    """
    is_inlier: list[Bool[np.ndarray, "M"]] = []
    for pair in pairs:
        first, second = (pair.keypoints / longest).transpose(1, 0, 2)  # one unit for all sizes
        _, inliers = cv2.findFundamentalMat(first, second, cv2.FM_RANSAC, EPIPOLAR_TOLERANCE, 0.99, MAX_ITERATIONS)
        is_inlier.append(np.zeros(len(first), bool) if inliers is None else inliers[:, 0] > 0)
    return float(np.concatenate(is_inlier).mean())
