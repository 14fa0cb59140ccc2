from dataclasses import replace

import numpy as np
import pytest

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.bundle_adjustment import (
    LENS_PARAMETERS,
    Bundle,
    BundleProblem,
    adjust_bundle,
    lens_to_vector,
)
from nerf_lightning.capture.poses.geometry import angle_between, invert_pose, project_points, rotvec_to_matrix
from nerf_lightning.capture.tags.detect import TagDetection
from nerf_lightning.capture.tags.tag_layout import UNIT_SQUARE
from tests.helpers.tag_views import LENS, SIX_TAGS, TAG_SIZE, make_observations, make_poses


def bundle(photos: int = 8, noise: float = 0.0, tag_shift: float = 0.0, seed: int = 0) -> Bundle:
    """The true bundle, or one perturbed by `tag_shift` radians and centimeters."""
    rng = np.random.default_rng(seed)
    c2w = make_poses(photos, seed)
    seen = make_observations(SIX_TAGS, c2w, noise=noise, seed=seed)
    nudge = [
        rotvec_to_matrix(tag_shift * rng.standard_normal(3), tag_shift * rng.standard_normal(3) / 10)
        for _ in range(photos + 6)
    ]
    w2c = np.stack([n @ invert_pose(pose) for n, pose in zip(nudge, c2w, strict=False)])
    tags = [SIX_TAGS.poses[tag] @ n for tag, n in zip(range(1, 6), nudge[photos:], strict=False)]
    return Bundle(LENS, w2c, np.stack([SIX_TAGS.poses[0], *tags]), [s.detections for s in seen], np.zeros(6))


def test_bundle_problem_jacobian_matches_finite_differences():
    made = replace(bundle(3, noise=0.5, tag_shift=0.05), twists=1e-3 * np.arange(6.0))
    bent = Distortion(k1=-0.2, k2=0.05, p1=0.001, p2=-0.002, k3=0.01)
    made = replace(made, lens=replace(LENS, distortion=bent, fy=910.0))
    problem = BundleProblem(made, LENS_PARAMETERS, frozenset({0}), True)
    x = problem.start[problem.free]
    x[9:] += 1e-2 * np.random.default_rng(0).standard_normal(len(x) - 9)
    jacobian = problem.jacobian(x).toarray()
    for i, step in enumerate(np.diag(1e-6 * np.maximum(1.0, np.abs(x)))):
        slope = (problem.residuals(x + step) - problem.residuals(x - step)) / (2 * step[i])
        np.testing.assert_allclose(jacobian[:, i], slope, rtol=1e-4, atol=1e-4 * max(1.0, np.abs(slope).max()))
    first = made.detections[0][0]
    again = project_points(made.lens, made.w2c[0] @ made.tags[0], first.points) - first.pixels
    np.testing.assert_allclose(problem.residuals(problem.start[problem.free])[:8], again.reshape(-1), atol=1e-9)


def test_adjust_bundle_of_exact_detections_finds_truth():
    found = adjust_bundle(bundle(tag_shift=0.03), ("focal", "cx", "cy", "k1", "k2"))
    assert found.total_rms < 1e-4
    np.testing.assert_allclose(lens_to_vector(found.bundle.lens), lens_to_vector(LENS), rtol=1e-5, atol=1e-6)
    for pose, truth in zip(found.bundle.w2c, bundle().w2c, strict=True):
        assert angle_between(pose, truth) < 1e-5 and np.abs(pose - truth).max() < 1e-5


def test_adjust_bundle_with_fixed_parameters_keeps_them():
    start = bundle(noise=0.2, tag_shift=0.01)
    found = adjust_bundle(start, (), frozenset(range(6))).bundle
    assert found.lens == start.lens
    assert np.array_equal(found.tags, start.tags) and not found.twists.any()
    assert adjust_bundle(start).deviations == {}


def test_adjust_bundle_with_wrong_corner_keeps_lens():
    start = bundle(noise=0.05, tag_shift=0.01)
    detections = dict(start.detections[2])
    wrong = detections[4].pixels + np.array([[40.0, -30.0], [0, 0], [0, 0], [0, 0]])
    detections[4] = TagDetection(detections[4].points, wrong)
    spoilt = replace(start, detections=[*start.detections[:2], detections, *start.detections[3:]])
    found = adjust_bundle(spoilt, ("focal", "k1", "k2"))
    assert abs(found.bundle.lens.fx / LENS.fx - 1) < 0.003
    assert found.rms.argmax() == 2 and found.rms[2] > 5


def test_adjust_bundle_deviations_match_std_of_repeated_fits():
    focals, reported = [], []
    for seed in range(12):
        start = bundle(6, noise=0.2)
        seen = make_observations(SIX_TAGS, make_poses(6, 0), noise=0.2, seed=100 + seed)
        found = adjust_bundle(replace(start, detections=[s.detections for s in seen]), ("focal", "k1"))
        focals.append(found.bundle.lens.fx)
        reported.append(found.deviations["focal"])
    assert 0.5 < np.std(focals) / np.mean(reported) < 2


def test_adjust_bundle_of_twisted_tag_finds_twist():
    twist, c2w, rng = 7e-4, make_poses(8, 3), np.random.default_rng(0)
    lifted = TAG_SIZE * UNIT_SQUARE + twist * np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1], [0, 0, 1]])
    seen = [project_points(LENS, invert_pose(pose), lifted) + 0.1 * rng.standard_normal((4, 2)) for pose in c2w]
    w2c, detections = (
        np.stack([invert_pose(pose) for pose in c2w]),
        [{0: TagDetection(TAG_SIZE * UNIT_SQUARE, pixels)} for pixels in seen],
    )
    start = Bundle(LENS, w2c, np.eye(4)[None], detections, np.zeros(1))
    flat, bent = adjust_bundle(start), adjust_bundle(start, free_twists=True)
    assert bent.bic < flat.bic and bent.total_rms < 0.3 * flat.total_rms
    assert bent.bundle.twists[0] == pytest.approx(twist, rel=0.1)
