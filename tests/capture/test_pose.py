from dataclasses import replace

import numpy as np

from benchmarks.capture import count_flips
from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import (
    angle_between,
    folds,
    inverse,
    normalised,
    project,
    to_matrix,
    to_vector,
)
from nerf_lightning.capture.poses.pose import mark_poses, photo_poses
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.capture.tags.layout import SQUARE
from tests.helpers.tag_views import LENS, SIX, SIZE, camera, cameras, sightings


def test_to_vector_inverts_to_matrix():
    rng = np.random.default_rng(0)
    for vector in rng.standard_normal((20, 6)):
        matrix = to_matrix(vector)
        np.testing.assert_allclose(to_vector(matrix), vector, atol=1e-9)
        np.testing.assert_allclose(inverse(matrix) @ matrix, np.eye(4), atol=1e-12)
    turned = to_matrix(np.array([0, 0, 1e-6, 1, 2, 3]))
    np.testing.assert_allclose(angle_between(turned, np.eye(4)), 1e-6, rtol=1e-5)
    np.testing.assert_allclose(angle_between(to_matrix(np.array([3.0, 0, 0, 0, 0, 0])), np.eye(4)), 3.0, rtol=1e-6)


def test_normalised_inverts_project():
    points = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    pixels = project(LENS, np.eye(4), np.concatenate([points, np.ones((50, 1))], axis=1))
    np.testing.assert_allclose(normalised(LENS, pixels), points, atol=1e-9)


def test_mark_poses_of_exact_tag_gives_true_pose_first():
    for pose in cameras(20, 1):
        mark = Mark(SIZE * SQUARE, project(LENS, inverse(pose), SIZE * SQUARE))
        best, *_ = mark_poses(LENS, mark)
        assert angle_between(best.pose, inverse(pose)) < 1e-4 and best.squares < 1e-6


def test_mark_poses_of_far_tag_gives_two():
    pose = camera([0.3, 0.1, 1.0], [0, 0, 0])
    solutions = mark_poses(LENS, Mark(SIZE * SQUARE, project(LENS, inverse(pose), SIZE * SQUARE)))
    assert len(solutions) == 2
    assert angle_between(solutions[1].pose, inverse(pose)) > np.radians(15)
    assert solutions[1].squares < 8 * 0.5**2  # half a pixel of noise would hide the difference


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
    world = [(SIZE * SQUARE, pixels) for _, pixels in seen]
    assert resolve_flips(LENS, options, world) == [0] * 15


def test_folds_of_turning_polynomial_is_true():
    assert not folds(LENS) and not folds(replace(LENS, distortion=Distortion()))
    assert not folds(replace(LENS, distortion=Distortion(k1=-0.3, k2=0.1)))
    assert folds(replace(LENS, distortion=Distortion(k1=0.16, k2=-1.0)))  # turns back, and never reaches the corner
    assert folds(replace(LENS, distortion=Distortion(k1=-4.0, k3=30.0)))  # turns back, and comes again
