"""Perspective-n-point for planar tags, with both solutions of the pose ambiguity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import (
    angle_between,
    apply_pose,
    invert_pose,
    project_points,
    rotvec_to_matrix,
)
from nerf_lightning.capture.tags.detect import TagDetection
from nerf_lightning.dataset.intrinsics import Intrinsics

Pose = Float[np.ndarray, "4 4"]
MIN_POSE_DIFFERENCE_RAD = np.radians(1.0)
"""Rotation below which two solutions count as one."""
MAX_HYPOTHESES = 2
"""Most solutions per photo."""


@dataclass(frozen=True)
class Hypothesis:
    """A candidate pose with its reprojection error."""

    pose: Pose
    """World (or tag) to camera."""
    sum_of_squares: float
    """Sum of squared reprojection distances, pixels^2."""


def evaluate_pose(
    lens: Intrinsics, pose: Pose, points: Float[np.ndarray, "M 3"], pixels: Float[np.ndarray, "M 2"]
) -> Hypothesis:
    """Computes a pose's reprojection error, infinite if a point is behind the camera."""
    if (apply_pose(pose, points)[:, 2] <= 0).any():
        return Hypothesis(pose, float("inf"))
    return Hypothesis(pose, float(((project_points(lens, pose, points) - pixels) ** 2).sum()))


def refine_pose(
    lens: Intrinsics, pose: Pose, points: Float[np.ndarray, "M 3"], pixels: Float[np.ndarray, "M 2"]
) -> Hypothesis:
    """Refines a pose by Levenberg-Marquardt on the reprojection error."""
    start = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
    rotation, translation = cv2.solvePnPRefineLM(points, pixels, lens.K, lens.opencv_distortion, *start)
    refined = rotvec_to_matrix(rotation.reshape(3), translation.reshape(3))
    candidates = [evaluate_pose(lens, candidate, points, pixels) for candidate in (refined, pose)]
    return min(candidates, key=lambda h: h.sum_of_squares)


def deduplicate(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best distinct hypotheses, best first."""
    unique: list[Hypothesis] = []
    for candidate in sorted(hypotheses, key=lambda h: h.sum_of_squares):
        is_new = all(angle_between(candidate.pose, kept.pose) > MIN_POSE_DIFFERENCE_RAD for kept in unique)
        if is_new and np.isfinite(candidate.sum_of_squares):
            unique.append(candidate)
    return unique[:MAX_HYPOTHESES]


def estimate_tag_poses(lens: Intrinsics, detection: TagDetection) -> list[Hypothesis]:
    """Tag-to-camera poses from one planar tag: one or two solutions, best first.

    A planar target seen from afar has two poses (Collins and Bartoli 2014, "Infinitesimal plane-based pose estimation")
    that its reprojection error often cannot distinguish.
    """
    points, pixels, flags = detection.points, detection.pixels, cv2.SOLVEPNP_IPPE
    ok, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, lens.K, lens.opencv_distortion, flags=flags)
    poses = [rotvec_to_matrix(r.reshape(3), t.reshape(3)) for r, t in zip(turns, shifts, strict=True)] if ok else []
    return deduplicate([refine_pose(lens, pose, points, pixels) for pose in poses])


def estimate_camera_poses(
    lens: Intrinsics, detections: dict[int, TagDetection], tags: Mapping[int, Pose]
) -> list[Hypothesis]:
    """World-to-camera poses from all tags of a photo together, best first.

    Args:
        detections: by tag; those not in `tags` are ignored.
        tags: tag to world.
    """
    known = {tag: detection for tag, detection in detections.items() if tag in tags}
    if not known:
        return []
    points, pixels = collect_correspondences(known, tags)
    starts = [h.pose @ invert_pose(tags[tag]) for tag in known for h in estimate_tag_poses(lens, known[tag])]
    rough = deduplicate([evaluate_pose(lens, start, points, pixels) for start in starts])
    return deduplicate([refine_pose(lens, hypothesis.pose, points, pixels) for hypothesis in rough])


def collect_correspondences(
    detections: Mapping[int, TagDetection], tags: Mapping[int, Pose]
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 2"]]:
    """World points of a photo's known tags, and their pixels."""
    known = {tag: detection for tag, detection in detections.items() if tag in tags}
    points = [apply_pose(tags[tag], detection.points) for tag, detection in known.items()]
    return np.concatenate(points), np.concatenate([detection.pixels for detection in known.values()])
