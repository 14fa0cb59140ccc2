import numpy as np
import pytest

from benchmarks.capture_accuracy import count_flips
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import (
    angle_between,
    invert_pose,
    normalize_pixels,
    project_points,
    rotvec_to_matrix,
)
from nerf_lightning.capture.poses.planar_pnp import estimate_camera_poses, estimate_tag_poses
from nerf_lightning.capture.tags.detect import TagDetection
from nerf_lightning.capture.tags.tag_layout import UNIT_SQUARE
from tests.helpers.tag_views import LENS, SIX_TAGS, TAG_SIZE, make_observations, make_pose, make_poses


def test_angle_between_of_small_and_large_turn_is_exact():
    for angle in (1e-6, 3.0):
        turned = rotvec_to_matrix(np.array([0, 0, angle]), np.array([1.0, 2.0, 3.0]))
        assert angle_between(turned, np.eye(4)) == pytest.approx(angle, rel=1e-5)
        np.testing.assert_allclose(invert_pose(turned) @ turned, np.eye(4), atol=1e-12)


def test_normalize_pixels_of_projected_points_inverts_projection():
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    pixels = project_points(LENS, np.eye(4), np.concatenate([points, np.ones((50, 1))], axis=1))
    np.testing.assert_allclose(normalize_pixels(LENS, pixels), points, atol=1e-9)


def test_estimate_tag_poses_of_exact_tag_gives_true_then_flipped_pose():
    for pose in make_poses(20, 1):
        mark = TagDetection(TAG_SIZE * UNIT_SQUARE, project_points(LENS, invert_pose(pose), TAG_SIZE * UNIT_SQUARE))
        best, *_ = estimate_tag_poses(LENS, mark)
        assert angle_between(best.pose, invert_pose(pose)) < 1e-4 and best.sum_of_squares < 1e-6
    pose = make_pose([0.3, 0.1, 1.0], [0, 0, 0])
    _, second = estimate_tag_poses(
        LENS, TagDetection(TAG_SIZE * UNIT_SQUARE, project_points(LENS, invert_pose(pose), TAG_SIZE * UNIT_SQUARE))
    )
    assert angle_between(second.pose, invert_pose(pose)) > np.radians(15)
    assert second.sum_of_squares < 8 * 0.5**2  # half a pixel of noise would hide the difference


def test_estimate_camera_poses_of_six_tags_gives_true_pose_first():
    for seen, pose in zip(make_observations(SIX_TAGS, make_poses(10, 2), noise=0.3), make_poses(10, 2), strict=True):
        best, *_ = estimate_camera_poses(LENS, seen.detections, SIX_TAGS.poses)
        assert angle_between(best.pose, invert_pose(pose)) < np.radians(0.6)
    assert estimate_camera_poses(LENS, {}, SIX_TAGS.poses) == []
    assert estimate_camera_poses(LENS, seen.detections, {99: np.eye(4)}) == []


def test_resolve_flips_of_slow_walk_leaves_none():
    found = count_flips(seed=3, count=80, tilt=15.0, pace=40)
    assert found["alone"] >= 4 and found["in_order"] == 0


def test_resolve_flips_of_scattered_photos_keeps_their_best():
    c2w, rng = make_poses(15, 5, tilt=45), np.random.default_rng(7)
    points = SIX_TAGS.corners(4)
    exact = [project_points(LENS, invert_pose(pose), points) for pose in c2w]
    seen = [(points, pixels + 0.1 * rng.standard_normal((4, 2))) for pixels in exact]
    options = [estimate_tag_poses(LENS, TagDetection(TAG_SIZE * UNIT_SQUARE, pixels)) for _, pixels in seen]
    assert resolve_flips(options, [TAG_SIZE * UNIT_SQUARE] * 15) == [0] * 15
