from dataclasses import replace

import numpy as np
import pytest

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.bundle import LENS_PARAMETERS, Bundle, Problem, lens_vector, refine
from nerf_lightning.capture.poses.geometry import angle_between, inverse, project, to_matrix
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.capture.tags.layout import SQUARE
from tests.helpers.tag_views import LENS, SIX, SIZE, cameras, sightings


def bundle(photos: int = 8, noise: float = 0.0, off: float = 0.0, seed: int = 0) -> Bundle:
    """The truth, or a start that is `off` by so many radians and centimetres."""
    rng = np.random.default_rng(seed)
    c2w = cameras(photos, seed)
    seen = sightings(SIX, c2w, noise=noise, seed=seed)
    nudge = [to_matrix(off * rng.standard_normal(3), off * rng.standard_normal(3) / 10) for _ in range(photos + 6)]
    w2c = np.stack([n @ inverse(pose) for n, pose in zip(nudge, c2w, strict=False)])
    tags = [SIX.poses[tag] @ n for tag, n in zip(range(1, 6), nudge[photos:], strict=False)]
    return Bundle(LENS, w2c, np.stack([SIX.poses[0], *tags]), [s.marks for s in seen], np.zeros(6))


def test_problem_jacobian_matches_differences():
    made = replace(bundle(3, noise=0.5, off=0.05), twists=1e-3 * np.arange(6.0))
    made = replace(
        made, lens=replace(LENS, distortion=Distortion(k1=-0.2, k2=0.05, p1=0.001, p2=-0.002, k3=0.01), fy=910.0)
    )
    problem = Problem(made, LENS_PARAMETERS, frozenset({0}), True)
    x = problem.start[problem.free]
    x[9:] += 1e-2 * np.random.default_rng(0).standard_normal(len(x) - 9)
    jacobian = problem.jacobian(x).toarray()
    for i, step in enumerate(np.diag(1e-6 * np.maximum(1.0, np.abs(x)))):
        slope = (problem.residuals(x + step) - problem.residuals(x - step)) / (2 * step[i])
        np.testing.assert_allclose(jacobian[:, i], slope, rtol=1e-4, atol=1e-4 * max(1.0, np.abs(slope).max()))
    first = made.marks[0][0]
    again = project(made.lens, made.w2c[0] @ made.tags[0], first.points) - first.pixels
    np.testing.assert_allclose(problem.residuals(problem.start[problem.free])[:8], again.reshape(-1), atol=1e-9)


def test_refine_of_exact_marks_finds_truth():
    found = refine(bundle(off=0.03), ("focal", "cx", "cy", "k1", "k2"))
    assert found.total_rms < 1e-4
    np.testing.assert_allclose(lens_vector(found.bundle.lens), lens_vector(LENS), rtol=1e-5, atol=1e-6)
    for pose, truth in zip(found.bundle.w2c, bundle().w2c, strict=True):
        assert angle_between(pose, truth) < 1e-5 and np.abs(pose - truth).max() < 1e-5


def test_refine_keeps_what_is_not_free():
    start = bundle(noise=0.2, off=0.01)
    found = refine(start, (), frozenset(range(6))).bundle
    assert found.lens == start.lens
    assert np.array_equal(found.tags, start.tags) and not found.twists.any()
    assert refine(start).deviations == {}


def test_refine_with_wrong_corner_keeps_lens():
    start = bundle(noise=0.05, off=0.01)
    marks = dict(start.marks[2])
    wrong = marks[4].pixels + np.array([[40.0, -30.0], [0, 0], [0, 0], [0, 0]])
    marks[4] = Mark(marks[4].points, wrong)
    spoilt = replace(start, marks=[*start.marks[:2], marks, *start.marks[3:]])
    found = refine(spoilt, ("focal", "k1", "k2"))
    assert abs(found.bundle.lens.fx / LENS.fx - 1) < 0.003
    assert found.rms.argmax() == 2 and found.rms[2] > 5


def test_refine_deviations_match_spread_of_repeated_fits():
    focals, told = [], []
    for seed in range(12):
        start = bundle(6, noise=0.2)
        seen = sightings(SIX, cameras(6, 0), noise=0.2, seed=100 + seed)
        found = refine(replace(start, marks=[s.marks for s in seen]), ("focal", "k1"))
        focals.append(found.bundle.lens.fx)
        told.append(found.deviations["focal"])
    assert 0.5 < np.std(focals) / np.mean(told) < 2


def test_refine_of_twisted_tag_finds_twist():
    twist, c2w, rng = 7e-4, cameras(8, 3), np.random.default_rng(0)
    lifted = SIZE * SQUARE + twist * np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1], [0, 0, 1]])
    seen = [project(LENS, inverse(pose), lifted) + 0.1 * rng.standard_normal((4, 2)) for pose in c2w]
    w2c, marks = np.stack([inverse(pose) for pose in c2w]), [{0: Mark(SIZE * SQUARE, pixels)} for pixels in seen]
    start = Bundle(LENS, w2c, np.eye(4)[None], marks, np.zeros(1))
    flat, bent = refine(start), refine(start, free_twists=True)
    assert bent.bic < flat.bic and bent.total_rms < 0.3 * flat.total_rms
    assert bent.bundle.twists[0] == pytest.approx(twist, rel=0.1)
