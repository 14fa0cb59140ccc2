import numpy as np
import pytest

from benchmarks.capture import count_flips
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import (
    angle_between,
    inverse,
    normalised,
    project,
    to_matrix,
)
from nerf_lightning.capture.poses.pose import mark_poses, photo_poses
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.capture.tags.layout import SQUARE
from tests.helpers.tag_views import LENS, SIX, SIZE, camera, cameras, sightings


def test_angle_between_of_small_and_large_turn_is_exact():
    for angle in (1e-6, 3.0):
        turned = to_matrix(np.array([0, 0, angle]), np.array([1.0, 2.0, 3.0]))
        assert angle_between(turned, np.eye(4)) == pytest.approx(angle, rel=1e-5)
        np.testing.assert_allclose(inverse(turned) @ turned, np.eye(4), atol=1e-12)


def test_normalised_inverts_project():
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    pixels = project(LENS, np.eye(4), np.concatenate([points, np.ones((50, 1))], axis=1))
    np.testing.assert_allclose(normalised(LENS, pixels), points, atol=1e-9)


def test_mark_poses_of_exact_tag_gives_true_pose_first_and_the_flipped_one():
    for pose in cameras(20, 1):
        mark = Mark(SIZE * SQUARE, project(LENS, inverse(pose), SIZE * SQUARE))
        best, *_ = mark_poses(LENS, mark)
        assert angle_between(best.pose, inverse(pose)) < 1e-4 and best.squares < 1e-6
    pose = camera([0.3, 0.1, 1.0], [0, 0, 0])
    _, second = mark_poses(LENS, Mark(SIZE * SQUARE, project(LENS, inverse(pose), SIZE * SQUARE)))
    assert angle_between(second.pose, inverse(pose)) > np.radians(15)
    assert second.squares < 8 * 0.5**2  # half a pixel of noise would hide the difference


def test_photo_poses_of_six_tags_gives_true_pose_first():
    for seen, pose in zip(sightings(SIX, cameras(10, 2), noise=0.3), cameras(10, 2), strict=True):
        best, *_ = photo_poses(LENS, seen.marks, SIX.poses)
        assert angle_between(best.pose, inverse(pose)) < np.radians(0.6)
    assert photo_poses(LENS, {}, SIX.poses) == []
    assert photo_poses(LENS, seen.marks, {99: np.eye(4)}) == []


def test_resolve_flips_of_slow_walk_leaves_none():
    found = count_flips(seed=3, count=80, tilt=15.0, pace=40)
    assert found["alone"] >= 4 and found["in_order"] == 0


def test_resolve_flips_of_scattered_photos_keeps_their_best():
    c2w, rng = cameras(15, 5, tilt=45), np.random.default_rng(7)
    points = SIX.corners(4)
    seen = [(points, project(LENS, inverse(pose), points) + 0.1 * rng.standard_normal((4, 2))) for pose in c2w]
    options = [mark_poses(LENS, Mark(SIZE * SQUARE, pixels)) for _, pixels in seen]
    assert resolve_flips(options, [SIZE * SQUARE] * 15) == [0] * 15
