"""Camera poses from marks: every solution that flat tags allow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import angle_between, inverse, move, project, to_matrix
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.dataset.intrinsics import Intrinsics

Pose = Float[np.ndarray, "4 4"]
MIN_DIFFERENCE_RAD = np.radians(1.0)
"""Solutions that differ by less count as one."""
MAX_HYPOTHESES = 2
"""Solutions kept a photo."""


@dataclass(frozen=True)
class Hypothesis:
    """One place where a camera may have stood."""

    pose: Pose
    """World (or tag) to camera."""
    squares: float
    """Sum of squared reprojection distances, pixels^2."""


def rate(
    lens: Intrinsics, pose: Pose, points: Float[np.ndarray, "M 3"], pixels: Float[np.ndarray, "M 2"]
) -> Hypothesis:
    """A pose with its reprojection error, which is infinite where a point is behind the camera."""
    if (move(pose, points)[:, 2] <= 0).any():
        return Hypothesis(pose, float("inf"))
    return Hypothesis(pose, float(((project(lens, pose, points) - pixels) ** 2).sum()))


def polish(
    lens: Intrinsics, pose: Pose, points: Float[np.ndarray, "M 3"], pixels: Float[np.ndarray, "M 2"]
) -> Hypothesis:
    """The nearest minimum of the reprojection error (Levenberg-Marquardt)."""
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, lens.K, lens.opencv, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
    )
    better = to_matrix(rotation.reshape(3), translation.reshape(3))
    return min(rate(lens, better, points, pixels), rate(lens, pose, points, pixels), key=lambda h: h.squares)


def distinct(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best ones, best first, without repeats."""
    kept: list[Hypothesis] = []
    for one in sorted(hypotheses, key=lambda h: h.squares):
        if np.isfinite(one.squares) and all(angle_between(one.pose, k.pose) > MIN_DIFFERENCE_RAD for k in kept):
            kept.append(one)
    return kept[:MAX_HYPOTHESES]


def mark_poses(lens: Intrinsics, mark: Mark) -> list[Hypothesis]:
    """Tag to camera from one flat mark: one solution or two, best first.

    A flat target seen from afar looks the same from two sides (Collins and Bartoli 2014, "Infinitesimal plane-based pose
    estimation"), and its own reprojection error often cannot tell which one is right.
    """
    distortion = lens.opencv
    found, turns, shifts, _ = cv2.solvePnPGeneric(mark.points, mark.pixels, lens.K, distortion, flags=cv2.SOLVEPNP_IPPE)
    poses = [to_matrix(r.reshape(3), t.reshape(3)) for r, t in zip(turns, shifts, strict=True)] if found else []
    return distinct([polish(lens, pose, mark.points, mark.pixels) for pose in poses])


def photo_poses(lens: Intrinsics, marks: dict[int, Mark], tags: Mapping[int, Pose]) -> list[Hypothesis]:
    """World to camera from all marks of a photo together, best first.

    Args:
        marks: by tag; those without a place in `tags` are left out.
        tags: tag to world.
    """
    known = {tag: mark for tag, mark in marks.items() if tag in tags}
    if not known:
        return []
    points, pixels = points_and_pixels(known, tags)
    starts = [h.pose @ inverse(tags[tag]) for tag, mark in known.items() for h in mark_poses(lens, mark)]
    rough = distinct([rate(lens, start, points, pixels) for start in starts])
    return distinct([polish(lens, hypothesis.pose, points, pixels) for hypothesis in rough])


def points_and_pixels(
    marks: Mapping[int, Mark], tags: Mapping[int, Pose]
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 2"]]:
    """Points of a photo's known tags in the world, and where the photo shows them."""
    known = {tag: mark for tag, mark in marks.items() if tag in tags}
    points = [move(tags[tag], mark.points) for tag, mark in known.items()]
    return np.concatenate(points), np.concatenate([mark.pixels for mark in known.values()])
