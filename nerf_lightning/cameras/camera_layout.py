"""How a capture's cameras are laid out: around a subject, on one side of it, turning on a spot, or along a walk."""

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
"""See `find_convergence`: 1 where all look at a point, 0 or less where they might look in one direction."""
MAX_PARALLEL_VARIANCE = 1e-5
"""Circular variance below which axes are parallel: within a quarter of a degree."""
MAX_PAN_SPREAD_RATIO = 0.05
"""Largest spread of the centres of a camera that turns on a spot, as a share of the depth of what it sees."""
MAX_FORWARD_SPREAD_RATIO = 1.5
"""Largest spread of forward-facing cameras likewise; farther apart, they do not look at one thing."""
SINGLE_PRECISION_EPS, DOUBLE_PRECISION_EPS = 5e-7, 1e-12
"""Centres that spread by less than this share of their coordinates are the same, by the precision they are given in."""
DENSITY_CONCENTRATION, MAX_DENSITY_WEIGHT = 8.0, 3.0
"""Concentration of the kernel that estimates how densely directions are seen from, and the largest weight of a lone view."""
MAX_POINTS = 4096


class CameraLayout(StrEnum):
    """What a capture's poses say about how it was taken."""

    INWARD = "inward"
    """Around a subject, or an arc of more than about 70 degrees: axes meet in front of the cameras."""
    FORWARD = "forward"
    """From one side: axes nearly parallel, converging or slightly diverging."""
    PAN = "pan"
    """Turning on a spot, as on a tripod: centres differ by next to nothing. A single camera, too."""
    WALK = "walk"
    """Anything else: rooms walked through, streets, fly-throughs."""


def classify_layout(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"] | None = None) -> CameraLayout:
    """Classifies cameras by their poses (OpenCV, camera to world).

    Poses alone do not tell the depth of the scene: a pan whose centre moves is a walk then.

    Args:
        c2w: at least one pose; any similarity gives the same answer.
        points: on surfaces, in the poses' frame; they tell the depth.
    """
    c2w = c2w.double()
    centres, axes = c2w[:, :3, 3], normalize(c2w[:, :3, 2], dim=1)
    spread = centre_spread(c2w)
    if spread == 0:
        return CameraLayout.PAN
    depth = None if points is None else median_depth(c2w, points)
    if depth is not None and spread < MAX_PAN_SPREAD_RATIO * depth:
        return CameraLayout.PAN
    if circular_variance(axes) <= MAX_FORWARD_VARIANCE:
        too_wide = depth is not None and spread > MAX_FORWARD_SPREAD_RATIO * depth
        return CameraLayout.WALK if too_wide or is_dolly(centres, axes) else CameraLayout.FORWARD
    return CameraLayout.WALK if find_convergence(c2w) is None else CameraLayout.INWARD


def circular_variance(directions: Float[Tensor, "V 3"]) -> float:
    """1 - the length of the mean of unit vectors: 0 where all are the same, 1 where they cancel out."""
    return 1 - float(directions.mean(0).norm())


def centre_spread(c2w: Float[Tensor, "V 4 4"]) -> float:
    """Median distance of the centres from their median; 0 where they differ by rounding alone."""
    centres = c2w[:, :3, 3].double()
    distance = (centres - centres.median(0).values).norm(dim=1)
    spread = float(distance.median()) or float(distance.mean())
    is_single = bool((centres == centres.float()).all())
    rounding = SINGLE_PRECISION_EPS if is_single else DOUBLE_PRECISION_EPS
    return spread if spread > rounding * float(centres.abs().max()) else 0.0


def median_depth(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"]) -> float | None:
    """Median distance, over the cameras, to the points within 45 degrees of the axis; None where no camera has any."""
    some = points[:: -(-len(points) // MAX_POINTS)].double() if len(points) else points.double()
    depths = []
    for pose in c2w.double():
        local = (some - pose[:3, 3]) @ pose[:3, :3]
        distance = local.norm(dim=1)
        ahead = local[:, 2] > 0.7 * distance
        if ahead.any():
            depths.append(distance[ahead].median())
    return float(torch.stack(depths).median()) if depths else None


def is_dolly(centres: Float[Tensor, "V 3"], axes: Float[Tensor, "V 3"]) -> bool:
    """Whether centres spread along the mean axis more than across it."""
    offset = centres - centres.mean(0)
    axial = offset @ normalize(axes.mean(0), dim=0)
    return bool(2 * axial.square().sum() > offset.square().sum())


def find_convergence(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"] | None:
    """The point that cameras look at together, double precision; None where they look at none.

    It has to explain where they look better than one direction does: 1 - (mean of 1 - cos of the angles between axes and the
    point) / (circular variance of the axes) is at least `MIN_CONVERGENCE`.
    """
    variance = circular_variance(normalize(c2w[:, :3, 2].double(), dim=1))
    if centre_spread(c2w) == 0 or variance < MAX_PARALLEL_VARIANCE:
        return None
    target = find_focus_point(c2w)
    return target if 1 - (1 - float(axis_cosines(c2w, target[None])[0].mean())) / variance >= MIN_CONVERGENCE else None


def axis_cosines(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"]) -> Float[Tensor, "P V"]:
    """Cosine of the angle between each camera's axis and its direction to each point."""
    toward = normalize(points[:, None] - c2w[:, :3, 3].double(), dim=2)
    return (toward * normalize(c2w[:, :3, 2].double(), dim=1)).sum(2)


def find_focus_point(c2w: Float[Tensor, "V 4 4"]) -> Float[Tensor, "3"]:
    """The point in front of the cameras that is nearest to their axes by angle; far away where axes do not converge.

    Maximises the mean cosine between axes and directions to the point, each view weighted by how few others look from
    its direction. For cameras all around that are framed to one side alike, that is the middle of their circle.
    """
    c2w = c2w.double().clone()
    middle = c2w[:, :3, 3].mean(0)
    size = float((c2w[:, :3, 3] - middle).norm(dim=1).mean()) or 1.0
    c2w[:, :3, 3] = (c2w[:, :3, 3] - middle) / size
    centres, axes = c2w[:, :3, 3], normalize(c2w[:, :3, 2], dim=1)
    ahead = [centres + reach * axes for reach in (0.5, 1.0, 2.0, 4.0)]
    start = torch.cat([torch.zeros_like(centres[:1]), *ahead])
    start = start[:: -(-len(start) // 512)]
    weights = torch.full_like(centres[:, 0], 1 / len(centres))
    point = start[(axis_cosines(c2w, start) @ weights).argmax()]
    for _ in range(3):
        point = _maximize_mean_cosine(c2w, point, weights)
        toward = normalize(point - centres, dim=1)
        density = torch.exp(DENSITY_CONCENTRATION * (toward @ toward.T - 1)).sum(1)
        weights = (1 / density).clamp_max(MAX_DENSITY_WEIGHT / float(density.median()))
        weights = weights / weights.sum()
    return middle + size * point


def _maximize_mean_cosine(
    c2w: Float[Tensor, "V 4 4"], point: Float[Tensor, "3"], weights: Float[Tensor, "V"]
) -> Float[Tensor, "3"]:
    """The nearest maximum of the weighted mean cosine, by Levenberg-Marquardt on the chords between directions and axes."""
    centres, axes = c2w[:, :3, 3].cpu().numpy(), normalize(c2w[:, :3, 2], dim=1).cpu().numpy()
    root = weights.sqrt()[:, None].cpu().numpy()

    def chords(candidate: Float[np.ndarray, "3"]) -> Float[np.ndarray, "R"]:
        offset = candidate - centres
        return (root * (offset / np.linalg.norm(offset, axis=1, keepdims=True).clip(1e-12) - axes)).ravel()

    start = point.cpu().numpy()
    solution = least_squares(chords, start, method="lm", xtol=1e-12, ftol=1e-14, gtol=1e-14, max_nfev=400).x
    return torch.from_numpy(solution).to(point)
