"""Camera layouts: inward-facing, forward-facing, a pan, or a walk; and the point that cameras look at."""

from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import least_squares
from torch import Tensor
from torch.nn.functional import normalize

MAX_FORWARD_VARIANCE = 0.1
"""Largest circular variance (1 - length of the mean axis) of forward-facing cameras: axes within about 35 degrees."""
MIN_CONVERGENCE = 0.4
"""Lowest score of `find_convergence`: 1 if all axes meet, 0 or less if one direction explains them as well."""
MAX_PARALLEL_VARIANCE = 1e-5
"""Circular variance below which axes count as parallel: within a quarter of a degree."""
MAX_PAN_SPREAD_RATIO = 0.05
"""Largest spread of the centers of a pan, relative to the median depth."""
MAX_FORWARD_SPREAD_RATIO = 1.5
"""Largest spread of forward-facing cameras, relative to the median depth; wider ones do not share a subject."""
SINGLE_PRECISION_EPS, DOUBLE_PRECISION_EPS = 5e-7, 1e-12
"""Spreads below this share of the coordinates are rounding, by the precision of the poses."""
DENSITY_CONCENTRATION, MAX_DENSITY_WEIGHT = 8.0, 3.0
"""Concentration (von Mises-Fisher) of the density estimate of viewing directions, and the largest weight of a lone view."""
MAX_POINTS = 4096


class CameraLayout(StrEnum):
    """How a scene was photographed, by its poses."""

    INWARD = "inward"
    """Around a subject, by an arc of more than about 70 degrees: axes meet in front of the cameras."""
    FORWARD = "forward"
    """From one side: axes nearly parallel, converging or slightly diverging."""
    PAN = "pan"
    """Rotating on the spot, as on a tripod: centers coincide. A single camera, too."""
    WALK = "walk"
    """Anything else: walks through rooms, streets, fly-throughs."""


def classify_layout(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"] | None = None) -> CameraLayout:
    """Classifies camera poses as inward, forward, pan or walk (see `CameraLayout`).

    Poses alone do not give the depth of the scene: without points, a pan whose center moves is a walk.

    Args:
        c2w: at least one pose, OpenCV, camera to world; the result is invariant to similarities.
        points: surface points in the poses' frame, for the depth.
    """
    c2w = c2w.double()
    centers, axes = c2w[:, :3, 3], normalize(c2w[:, :3, 2], dim=1)
    spread = center_spread(c2w)
    if spread == 0:
        return CameraLayout.PAN
    depth = None if points is None else median_depth(c2w, points)
    if depth is not None and spread < MAX_PAN_SPREAD_RATIO * depth:
        return CameraLayout.PAN
    if circular_variance(axes) <= MAX_FORWARD_VARIANCE:
        too_wide = depth is not None and spread > MAX_FORWARD_SPREAD_RATIO * depth
        return CameraLayout.WALK if too_wide or is_dolly(centers, axes) else CameraLayout.FORWARD
    return CameraLayout.WALK if find_convergence(c2w) is None else CameraLayout.INWARD


def circular_variance(directions: Float[Tensor, "V 3"]) -> float:
    """Circular variance of unit vectors, 1 - |mean|: 0 if all are equal, 1 if they cancel out."""
    return 1 - float(directions.mean(0).norm())


def center_spread(c2w: Float[Tensor, "V 4 4"]) -> float:
    """Median distance of the camera centers from their median; 0 if they differ by rounding alone."""
    centers = c2w[:, :3, 3].double()
    distance = (centers - centers.median(0).values).norm(dim=1)
    spread = float(distance.median()) or float(distance.mean())
    is_single = bool((centers == centers.float()).all())
    rounding = SINGLE_PRECISION_EPS if is_single else DOUBLE_PRECISION_EPS
    return spread if spread > rounding * float(centers.abs().max()) else 0.0


def median_depth(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"]) -> float | None:
    """Median over cameras of the median distance to points within 45 degrees of the axis; None if no camera has any."""
    subset = points[:: -(-len(points) // MAX_POINTS)].double() if len(points) else points.double()
    depths = []
    for pose in c2w.double():
        local = (subset - pose[:3, 3]) @ pose[:3, :3]
        distance = local.norm(dim=1)
        in_view = local[:, 2] > 0.7 * distance
        if in_view.any():
            depths.append(distance[in_view].median())
    return float(torch.stack(depths).median()) if depths else None


def is_dolly(centers: Float[Tensor, "V 3"], axes: Float[Tensor, "V 3"]) -> bool:
    """True if camera centers spread along the mean axis more than across it."""
    offset = centers - centers.mean(0)
    axial = offset @ normalize(axes.mean(0), dim=0)
    return bool(2 * axial.square().sum() > offset.square().sum())


def find_convergence(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"] | None:
    """The point where camera axes converge, double precision; None if they do not.

    Score: 1 - mean(1 - cos(angle between axis and point)) / (circular variance of the axes), at least `MIN_CONVERGENCE`.
    """
    variance = circular_variance(normalize(c2w[:, :3, 2].double(), dim=1))
    if center_spread(c2w) == 0 or variance < MAX_PARALLEL_VARIANCE:
        return None
    target = find_focus_point(c2w)
    return target if 1 - (1 - float(axis_cosines(c2w, target[None])[0].mean())) / variance >= MIN_CONVERGENCE else None


def axis_cosines(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"]) -> Float[Tensor, "P V"]:
    """Cosines of the angles between each camera's axis and its direction to each point."""
    directions = normalize(points[:, None] - c2w[:, :3, 3].double(), dim=2)
    return (directions * normalize(c2w[:, :3, 2].double(), dim=1)).sum(2)


def find_focus_point(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"]:
    """The focus point: nearest to all camera axes by angle; far away if the axes do not converge.

    Maximizes the mean cosine between axes and directions to the point, with views weighted by the inverse density of
    viewing directions. For a ring of cameras that all frame the subject to one side, that is the ring's center.
    """
    c2w = c2w.double().clone()
    middle = c2w[:, :3, 3].mean(0)
    size = float((c2w[:, :3, 3] - middle).norm(dim=1).mean()) or 1.0
    c2w[:, :3, 3] = (c2w[:, :3, 3] - middle) / size
    centers, axes = c2w[:, :3, 3], normalize(c2w[:, :3, 2], dim=1)
    candidates = [centers + reach * axes for reach in (0.5, 1.0, 2.0, 4.0)]
    start = torch.cat([torch.zeros_like(centers[:1]), *candidates])
    start = start[:: -(-len(start) // 512)]
    weights = torch.full_like(centers[:, 0], 1 / len(centers))
    point = start[(axis_cosines(c2w, start) @ weights).argmax()]
    for _ in range(3):
        point = _maximize_mean_cosine(c2w, point, weights)
        directions = normalize(point - centers, dim=1)
        density = torch.exp(DENSITY_CONCENTRATION * (directions @ directions.T - 1)).sum(1)
        weights = (1 / density).clamp_max(MAX_DENSITY_WEIGHT / float(density.median()))
        weights = weights / weights.sum()
    return middle + size * point


def _maximize_mean_cosine(
    c2w: Float[Tensor, "V 4 4"], point: Float[Tensor, "3"], weights: Float[Tensor, "V"]
) -> Float[Tensor, "3"]:
    """Local maximum of the weighted mean cosine, by Levenberg-Marquardt on the chords between directions and axes."""
    centers, axes = c2w[:, :3, 3].cpu().numpy(), normalize(c2w[:, :3, 2], dim=1).cpu().numpy()
    root = weights.sqrt()[:, None].cpu().numpy()

    def chords(candidate: Float[np.ndarray, "3"]) -> Float[np.ndarray, "R"]:
        offset = candidate - centers
        return (root * (offset / np.linalg.norm(offset, axis=1, keepdims=True).clip(1e-12) - axes)).ravel()

    start = point.cpu().numpy()
    solution = least_squares(chords, start, method="lm", xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=400).x
    return torch.from_numpy(solution).to(point)
