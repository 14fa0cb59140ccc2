"""Camera poses from marks: every solution that flat tags allow."""

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
"""Solutions that differ by less count as one."""
MAX_HYPOTHESES = 2
"""Solutions kept a photo."""


@dataclass(frozen=True)
class Hypothesis:
    """One place where a camera may have stood."""

    pose: Pose
    """World (or tag) to camera."""
    sum_of_squares: float
    """Sum of squared reprojection distances, pixels^2."""


def evaluate_pose(
    lens: Intrinsics, pose: Pose, points: Float[np.ndarray, "M 3"], pixels: Float[np.ndarray, "M 2"]
) -> Hypothesis:
    """A pose with its reprojection error, which is infinite where a point is behind the camera."""
    if (apply_pose(pose, points)[:, 2] <= 0).any():
        return Hypothesis(pose, float("inf"))
    return Hypothesis(pose, float(((project_points(lens, pose, points) - pixels) ** 2).sum()))


def refine_pose(
    lens: Intrinsics, pose: Pose, points: Float[np.ndarray, "M 3"], pixels: Float[np.ndarray, "M 2"]
) -> Hypothesis:
    """The nearest minimum of the reprojection error (Levenberg-Marquardt)."""
    rotation, translation = cv2.solvePnPRefineLM(
        points, pixels, lens.K, lens.opencv_distortion, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3:].copy()
    )
    better = rotvec_to_matrix(rotation.reshape(3), translation.reshape(3))
    return min(
        evaluate_pose(lens, better, points, pixels),
        evaluate_pose(lens, pose, points, pixels),
        key=lambda h: h.sum_of_squares,
    )


def deduplicate(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best ones, best first, without repeats."""
    unique: list[Hypothesis] = []
    for one in sorted(hypotheses, key=lambda h: h.sum_of_squares):
        if np.isfinite(one.sum_of_squares) and all(
            angle_between(one.pose, k.pose) > MIN_POSE_DIFFERENCE_RAD for k in unique
        ):
            unique.append(one)
    return unique[:MAX_HYPOTHESES]


def estimate_tag_poses(lens: Intrinsics, detection: TagDetection) -> list[Hypothesis]:
    """Tag to camera from one flat mark: one solution or two, best first.

    A flat target seen from afar looks the same from two sides (Collins and Bartoli 2014, "Infinitesimal plane-based pose
    estimation"), and its own reprojection error often cannot tell which one is right.
    """
    distortion = lens.opencv_distortion
    found, turns, shifts, _ = cv2.solvePnPGeneric(
        detection.points, detection.pixels, lens.K, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    poses = [rotvec_to_matrix(r.reshape(3), t.reshape(3)) for r, t in zip(turns, shifts, strict=True)] if found else []
    return deduplicate([refine_pose(lens, pose, detection.points, detection.pixels) for pose in poses])


def estimate_camera_poses(
    lens: Intrinsics, detections: dict[int, TagDetection], tags: Mapping[int, Pose]
) -> list[Hypothesis]:
    """World to camera from all marks of a photo together, best first.

    Args:
        detections: by tag; those without a place in `tags` are left out.
        tags: tag to world.
    """
    known = {tag: detection for tag, detection in detections.items() if tag in tags}
    if not known:
        return []
    points, pixels = collect_correspondences(known, tags)
    starts = [
        h.pose @ invert_pose(tags[tag]) for tag, detection in known.items() for h in estimate_tag_poses(lens, detection)
    ]
    rough = deduplicate([evaluate_pose(lens, start, points, pixels) for start in starts])
    return deduplicate([refine_pose(lens, hypothesis.pose, points, pixels) for hypothesis in rough])


def collect_correspondences(
    detections: Mapping[int, TagDetection], tags: Mapping[int, Pose]
) -> tuple[Float[np.ndarray, "M 3"], Float[np.ndarray, "M 2"]]:
    """Points of a photo's known tags in the world, and where the photo shows them."""
    known = {tag: detection for tag, detection in detections.items() if tag in tags}
    points = [apply_pose(tags[tag], detection.points) for tag, detection in known.items()]
    return np.concatenate(points), np.concatenate([detection.pixels for detection in known.values()])
