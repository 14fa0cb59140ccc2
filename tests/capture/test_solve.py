from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import angle_between, invert_pose, project_points
from nerf_lightning.capture.poses.pose_solver import chain_tag_poses, solve_poses, solve_without_outliers
from nerf_lightning.capture.tags.detect import TagDetection
from nerf_lightning.capture.tags.tag_layout import UNIT_SQUARE
from nerf_lightning.errors import InputError
from tests.helpers.tag_views import LENS, ONE_TAG, SIX_TAGS, TAG_SIZE, make_observations, make_poses

FOLDER = Path("calibration")


def max_tag_error(tags: dict[int, np.ndarray], reference: int) -> float:
    """Largest position error of a tag in the frame of the reference tag, meters."""
    home = invert_pose(SIX_TAGS.poses[reference])
    return max(float(np.linalg.norm((home @ SIX_TAGS.poses[tag])[:3, 3] - pose[:3, 3])) for tag, pose in tags.items())


def test_solve_poses_of_unknown_layout_finds_tags_and_cameras():
    c2w = make_poses(10)
    solution = solve_poses(LENS, make_observations(SIX_TAGS, c2w), None)
    assert sorted(solution.tags) == list(range(6)) and len(solution.w2c) == 10
    (reference,) = (tag for n, tag in enumerate(solution.tags) if n in solution.fixed)
    assert np.array_equal(solution.tags[reference], np.eye(4))
    assert max_tag_error(solution.tags, reference) < 3e-4
    truth = [invert_pose(pose) @ SIX_TAGS.poses[reference] for pose in c2w]
    off = [angle_between(*pair) for pair in zip(solution.w2c.values(), truth, strict=True)]
    assert np.median(off) < np.radians(0.1)
    known = solve_poses(LENS, make_observations(SIX_TAGS, c2w), SIX_TAGS.poses)  # keeps its frame
    for w2c, exact in zip(known.w2c.values(), c2w, strict=True):
        assert np.abs(invert_pose(w2c) - exact).max() < 3e-3


def test_solve_without_outliers_excludes_unlinked_photos():
    seen = make_observations(SIX_TAGS, make_poses(6))
    seen[1] = replace(seen[1], detections={})
    seen[4] = replace(seen[4], detections={17: seen[4].detections[0]})  # a tag that no other photo shows
    solution, photos = solve_without_outliers(seen, {}, lambda left: solve_poses(LENS, left, None))
    assert solution.photos == ("000.png", "002.png", "003.png", "005.png")
    assert photos[1].reason == "no tag found" and "not linked" in photos[4].reason
    for i, photo in enumerate(photos):
        assert photo.name == seen[i].name and (photo.c2w is None) == bool(photo.reason)
        for tag, rest in photo.residuals.items():
            again = project_points(LENS, invert_pose(photo.c2w) @ solution.tags[tag], seen[i].detections[tag].points)
            np.testing.assert_allclose(seen[i].detections[tag].pixels + rest, again, atol=0.2)
        if photo.residuals:
            squares = np.concatenate(list(photo.residuals.values())) ** 2
            assert photo.reprojection_px == pytest.approx(np.sqrt(squares.sum(1).mean()))
    with pytest.raises(InputError, match="the tags fit no camera"):
        solve_poses(LENS, [seen[1]], None)


def test_chain_tag_poses_follows_most_agreed_links():
    step = np.eye(4)
    step[0, 3] = 1.0
    wrong = np.eye(4)
    wrong[1, 3] = 5.0
    tags = chain_tag_poses({(0, 1): (step, 9), (1, 2): (step, 7), (0, 2): (wrong, 1), (5, 6): (step, 3)}, 0)
    assert sorted(tags) == [0, 1, 2]
    np.testing.assert_allclose(tags[2][:3, 3], [2, 0, 0])


def test_calibrate_with_one_tag_finds_focal():
    found = calibrate(FOLDER, make_observations(ONE_TAG, make_poses(20, tilt=45, distance=0.35)), None)
    assert abs(found.lens.fx / LENS.fx - 1) < 0.015
    assert set(found.excluded.values()) <= {"no tag found"} and found.rms < 0.2


def test_calibrate_with_unknown_layout_finds_lens():
    found = calibrate(FOLDER, make_observations(SIX_TAGS, make_poses(15)), None)
    assert abs(found.lens.fx / LENS.fx - 1) < 0.0015
    assert abs(found.lens.distortion.k1 + 0.2) < 0.01
    assert 0 < found.deviations["focal"] < 3
    assert found.warnings == []


def test_calibrate_with_few_photos_frees_few_parameters():
    found = calibrate(FOLDER, make_observations(SIX_TAGS, make_poses(3)), None)
    assert not any(found.lens.distortion) and set(found.deviations) == {"focal"}
    straight = replace(LENS, distortion=Distortion(), cx=512.0, cy=384.0)
    many = calibrate(FOLDER, make_observations(SIX_TAGS, make_poses(10), straight), None)
    assert max(abs(k) for k in many.lens.distortion) < 0.02


def test_calibrate_with_contradicting_photo_drops_it():
    seen = make_observations(SIX_TAGS, make_poses(9))
    shifted = {
        tag: TagDetection(TAG_SIZE * UNIT_SQUARE, m.pixels + [30 * (tag % 2), 25 * (tag % 3)])
        for tag, m in seen[7].detections.items()
    }
    seen[7] = replace(seen[7], detections=shifted)
    seen[3] = replace(seen[3], detections={})
    found = calibrate(FOLDER, seen, None)
    assert sorted(found.excluded) == ["003.png", "007.png"]
    assert "reprojection error" in found.excluded["007.png"] and found.excluded["003.png"] == "no tag found"
    assert abs(found.lens.fx / LENS.fx - 1) < 0.005


def test_calibrate_with_half_hidden_tag_drops_the_tag():
    seen = make_observations(SIX_TAGS, make_poses(9))
    hidden = seen[7].detections[2].pixels + np.array([[30.0, 20.0], [0, 0], [0, 0], [0, 0]])
    seen[7] = replace(seen[7], detections=seen[7].detections | {2: TagDetection(TAG_SIZE * UNIT_SQUARE, hidden)})
    found = calibrate(FOLDER, seen, None)
    assert found.excluded == {} and len(found.used_photos) == 9
    assert sorted(found.used_photos[7].detections) == [0, 1, 3, 4, 5]
    assert found.rms < 0.2


def test_calibrate_with_too_few_or_frontal_photos_raises():
    with pytest.raises(InputError, match="2 photos with tags of 5, expected at least 3"):
        two, none = make_observations(SIX_TAGS, make_poses(2)), make_observations(SIX_TAGS, make_poses(3))
        calibrate(FOLDER, [*two, *(replace(s, detections={}) for s in none)], None)
    with pytest.raises(InputError, match="tilt the camera by 20 to 45 degrees"):
        calibrate(FOLDER, make_observations(SIX_TAGS, make_poses(4, tilt=1.0), noise=0.5), None)
