"""Camera poses from marks: every solution that flat tags allow."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import (
    angle_between,
    inverse,
    move,
    normalised,
    project,
    to_matrix,
    to_vector,
)
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.dataset.intrinsics import Intrinsics

SAME = np.radians(1.0)
"""Solutions that differ by less count as one."""
HYPOTHESES = 2
"""Solutions kept a photo."""


@dataclass(frozen=True)
class Hypothesis:
    """One place where a camera may have stood."""

    pose: Float[np.ndarray, "4 4"]
    """World (or tag) to camera."""
    squares: float
    """Sum of squared reprojection distances, pixels^2."""


def squares_of(lens: Intrinsics, pose: Float[np.ndarray, "4 4"], points: np.ndarray, pixels: np.ndarray) -> float:
    """Sum of squared distances between projected points and their pixels; infinite where one is behind the camera."""
    if (move(pose, points)[:, 2] <= 0).any():
        return float("inf")
    return float(((project(lens, pose, points) - pixels) ** 2).sum())


def polished(lens: Intrinsics, pose: Float[np.ndarray, "4 4"], points: np.ndarray, pixels: np.ndarray) -> Hypothesis:
    """The nearest minimum of the reprojection error (Levenberg-Marquardt)."""
    vector = to_vector(pose)
    turn, shift = cv2.solvePnPRefineLM(
        points, pixels, lens.K, lens.opencv, vector[:3, None].copy(), vector[3:, None].copy()
    )
    better = to_matrix(np.concatenate([turn.reshape(3), shift.reshape(3)]))
    candidates = [Hypothesis(p, squares_of(lens, p, points, pixels)) for p in (better, pose)]
    return min(candidates, key=lambda h: h.squares)


def distinct(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best ones, best first, without repeats."""
    kept: list[Hypothesis] = []
    for hypothesis in sorted(hypotheses, key=lambda h: h.squares):
        if np.isfinite(hypothesis.squares) and all(angle_between(hypothesis.pose, k.pose) > SAME for k in kept):
            kept.append(hypothesis)
    return kept[:HYPOTHESES]


def mark_poses(lens: Intrinsics, mark: Mark) -> list[Hypothesis]:
    """Tag to camera from one flat mark: one solution or two, best first.

    A flat target seen from afar looks the same from two sides (Collins and Bartoli 2014, "Infinitesimal plane-based pose
    estimation"), and its own reprojection error often cannot tell which one is right.
    """
    tangents = normalised(lens, mark.pixels)
    found, turns, shifts, _ = cv2.solvePnPGeneric(mark.points, tangents, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return []
    poses = [to_matrix(np.concatenate([r.reshape(3), t.reshape(3)])) for r, t in zip(turns, shifts, strict=True)]
    return distinct([polished(lens, pose, mark.points, mark.pixels) for pose in poses])


def photo_poses(
    lens: Intrinsics, marks: dict[int, Mark], tags: dict[int, Float[np.ndarray, "4 4"]]
) -> list[Hypothesis]:
    """World to camera from all marks of a photo together, best first.

    Args:
        marks: by tag; those without a place in `tags` are left out.
        tags: tag to world.
    """
    if not any(tag in tags for tag in marks):
        return []
    points, pixels = points_and_pixels(marks, tags)
    alone = {tag: mark_poses(lens, mark) for tag, mark in marks.items() if tag in tags}
    starts = [hypothesis.pose @ inverse(tags[tag]) for tag, found in alone.items() for hypothesis in found]
    rough = distinct([Hypothesis(start, squares_of(lens, start, points, pixels)) for start in starts])
    return distinct([polished(lens, hypothesis.pose, points, pixels) for hypothesis in rough])


def points_and_pixels(
    marks: dict[int, Mark], tags: Mapping[int, Float[np.ndarray, "4 4"]]
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 2"]]:
    """Points of a photo's known tags in the world, and where the photo shows them."""
    known = {tag: mark for tag, mark in marks.items() if tag in tags}
    points = [move(tags[tag], mark.points) for tag, mark in known.items()]
    return np.concatenate(points), np.concatenate([mark.pixels for mark in known.values()])
