"""SIFT features of photos and matches between them: what the photos alone tell about the cameras that took them."""

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
"""Longest side of a photo when features are detected: larger ones are reduced, smaller ones enlarged."""
MAX_FEATURES, MAX_COARSE_FEATURES = 400, 128
"""Features of a photo; the first of them tell which photos may overlap."""
FEATURE_DIM = 128 + 3
MAX_RATIO = 0.8
"""Largest distance of a match, as a share of the second-best (Lowe 2004, section 7.1)."""
MIN_COARSE_MATCHES, MIN_MATCHES = 5, 8
"""Of the strongest features, for two photos to be matched at all; and of all of them, for a pair to count."""
PARTNERS_BY_PHOTO, PARTNERS_BY_POSE = 3, 2
"""Photos that each is matched with: those with most matches, and those whose cameras are nearest."""
MAX_PAIRS = 120
MIN_DISPLACEMENT = 0.02
"""Median displacement of a pair's matches, as a share of the longest side, below which nearly any camera explains it."""
EPIPOLAR_TOLERANCE, MAX_ITERATIONS = 0.004, 500
"""Of the fundamental matrix that the matches of a pair agree on, as a share of the longest side; and of RANSAC."""


@dataclass(frozen=True)
class Features:
    """Salient points of a photo."""

    keypoints: Float[np.ndarray, "F 2"]
    """Column and row, pixels of the photo; the first pixel's centre is at 0.5."""
    descriptors: Float[Tensor, "F D"]
    """RootSIFT (Arandjelovic and Zisserman 2012) and sRGB in [0, 1], which tells apart what is alike but for its colour; the
    strongest feature first."""


@dataclass(frozen=True)
class Pair:
    """Two photos, and matches between them, some of them wrong."""

    first: int
    second: int
    keypoints: Float[np.ndarray, "M 2 2"]
    """Of each match in the first and in the second photo, pixels."""

    @property
    def displacement(self) -> float:
        """Median distance between a match's two places, pixels."""
        return float(np.median(np.linalg.norm(self.keypoints[:, 1] - self.keypoints[:, 0], axis=1)))


def detect_features(views: Views, view: int) -> Features:
    """SIFT features of one of several photos, where it shows something."""
    image = views.image(view).numpy()
    shows = np.ones(image.shape[:2], bool) if views.valid_mask is None else views.view_mask(view).numpy()
    if image.shape[2] == 4:
        shows = shows & (image[..., 3] > 127)
    height, width = image.shape[:2]
    longest = max(height, width)
    scale = min(max(1.0, min(MIN_SIDE_PX / longest, MAX_ENLARGEMENT)), MAX_SIDE_PX / longest)
    size = max(1, round(width * scale)), max(1, round(height * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    colours = cv2.resize(np.ascontiguousarray(image[..., :3]), size, interpolation=method)
    mask = cv2.resize(shows.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    colours[mask == 0] = 127
    sift = cv2.SIFT.create(MAX_FEATURES, contrastThreshold=0.02)
    points, descriptors = sift.detectAndCompute(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), mask)
    if descriptors is None or not len(points):
        return Features(np.zeros((0, 2)), torch.zeros(0, FEATURE_DIM))
    order = np.argsort([-point.response for point in points], kind="stable")[:MAX_FEATURES]
    keypoints = np.array([points[i].pt for i in order], np.float64) + 0.5
    root = np.sqrt(descriptors[order] / descriptors[order].sum(1, keepdims=True).clip(1e-6))
    column, row = keypoints.astype(int).clip(0, np.array(size) - 1).T
    colour = cv2.GaussianBlur(colours, (0, 0), 2.0)[row, column] / 255
    together = torch.from_numpy(np.hstack([root, colour])).float()
    return Features(keypoints * [width / size[0], height / size[1]], together)


def match_features(first: Features, second: Features) -> Float[np.ndarray, "M 2 2"]:
    """Places of features that are each other's nearest, and clearly so."""
    if min(len(first.keypoints), len(second.keypoints)) < 2:
        return np.zeros((0, 2, 2))
    distance = torch.cdist(first.descriptors, second.descriptors)
    best, partner = distance.topk(2, dim=1, largest=False)
    index = torch.arange(len(distance))
    kept = (best[:, 0] < MAX_RATIO * best[:, 1]) & (distance.argmin(0)[partner[:, 0]] == index)
    return np.stack([first.keypoints[index[kept].numpy()], second.keypoints[partner[kept, 0].numpy()]], axis=1)


def count_matches(features: Sequence[Features]) -> Int[np.ndarray, "V V"]:
    """How many of the strongest features of each photo have a match in each other one, and in reverse, whichever is less."""
    table = torch.full((len(features), MAX_COARSE_FEATURES, FEATURE_DIM), 1e3)  # far from all, where there are fewer
    coarse = [one.descriptors[:MAX_COARSE_FEATURES] for one in features]
    for row, some in zip(table, coarse, strict=True):
        row[: len(some)] = some
    nearest = [torch.cdist(some, table).topk(2, dim=2, largest=False).values for some in coarse]
    found = torch.stack([(two[..., 0] < MAX_RATIO * two[..., 1]).sum(1) for two in nearest]).fill_diagonal_(0)
    return torch.minimum(found, found.T).numpy()


def find_pairs(features: Sequence[Features], cameras: Cameras) -> list[Pair]:
    """Matches between photos that seem to show the same, or whose cameras stand side by side and look the same way."""
    counts = count_matches(features)
    by_photo = np.argsort(-counts, axis=1, kind="stable")[:, :PARTNERS_BY_PHOTO]
    centres, axes = cameras.centres, cameras.c2w[:, :3, 2]
    spread = (centres - centres.mean(0)).norm(dim=1).mean().clamp_min(1e-12)
    distance = (torch.cdist(centres, centres) / spread + torch.cdist(axes, axes)).numpy()
    by_pose = np.argsort(distance, axis=1, kind="stable")[:, 1 : 1 + PARTNERS_BY_POSE]
    candidates = set()
    for view in range(len(cameras)):
        alike = [other for other in by_photo[view] if counts[view, other] >= MIN_COARSE_MATCHES]
        candidates |= {
            (min(view, int(other)), max(view, int(other))) for other in (*by_pose[view], *alike) if other != view
        }
    every = sorted(candidates)
    pairs = []
    for first, second in (every[i] for i in subsample(len(every), MAX_PAIRS)):
        pair = Pair(first, second, match_features(features[first], features[second]))
        if len(pair.keypoints) >= MIN_MATCHES and pair.displacement >= MIN_DISPLACEMENT * max(cameras.size(first)):
            pairs.append(pair)
    return pairs


def compute_ransac_inlier_ratio(pairs: Sequence[Pair], longest: int) -> float:
    """Share of the matches that agree on a fundamental matrix of their pair, whatever the cameras.

    Args:
        pairs: of photos.
        longest: their longest side, pixels.
    """
    agree: list[Bool[np.ndarray, "M"]] = []
    for pair in pairs:
        one, other = (pair.keypoints / longest).transpose(1, 0, 2)  # one unit for all sizes
        _, inliers = cv2.findFundamentalMat(one, other, cv2.FM_RANSAC, EPIPOLAR_TOLERANCE, 0.99, MAX_ITERATIONS)
        agree.append(np.zeros(len(one), bool) if inliers is None else inliers[:, 0] > 0)
    return float(np.concatenate(agree).mean())
