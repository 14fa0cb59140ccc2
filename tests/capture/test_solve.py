from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import angle_between, inverse
from nerf_lightning.capture.poses.solve import place_tags, solve
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.capture.tags.layout import SQUARE
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError
from tests.helpers.tag_views import LENS, ONE, SIX, SIZE, cameras, sightings

FOLDER = Path("calibration")


def worst_tag(tags: dict[int, np.ndarray], reference: int) -> float:
    """Metres between where a tag lies and where it was found, in the frame of the reference tag."""
    home = inverse(SIX.poses[reference])
    return max(float(np.linalg.norm((home @ SIX.poses[tag])[:3, 3] - pose[:3, 3])) for tag, pose in tags.items())


def test_solve_of_unknown_layout_finds_tags_and_cameras():
    c2w = cameras(10)
    solved = solve(LENS, [s.marks for s in sightings(SIX, c2w)], None)
    assert sorted(solved.tags) == list(range(6)) and len(solved.w2c) == 10
    (reference,) = (tag for n, tag in enumerate(solved.tags) if n in solved.fixed)
    assert np.array_equal(solved.tags[reference], np.eye(4))
    assert worst_tag(solved.tags, reference) < 3e-4
    off = [angle_between(w2c, inverse(c2w[i]) @ SIX.poses[reference]) for i, w2c in solved.w2c.items()]
    assert np.median(off) < np.radians(0.1)


def test_solve_of_known_layout_keeps_its_frame():
    c2w = cameras(6)
    solved = solve(LENS, [s.marks for s in sightings(SIX, c2w)], SIX.poses)
    for i, w2c in solved.w2c.items():
        assert np.abs(inverse(w2c) - c2w[i]).max() < 3e-3


def test_solve_leaves_out_unlinked_photos():
    seen = [s.marks for s in sightings(SIX, cameras(6))]
    seen[1] = {}
    seen[4] = {17: seen[4][0]}  # a tag that no other photo shows
    solved = solve(LENS, seen, None)
    assert solved.placed == [0, 2, 3, 5]
    assert solve(LENS, [{}, {}], None) is None


def test_place_tags_follows_most_agreed_links():
    step = np.eye(4)
    step[0, 3] = 1.0
    wrong = np.eye(4)
    wrong[1, 3] = 5.0
    tags = place_tags({(0, 1): (step, 9), (1, 2): (step, 7), (0, 2): (wrong, 1), (5, 6): (step, 3)}, 0)
    assert sorted(tags) == [0, 1, 2]
    np.testing.assert_allclose(tags[2][:3, 3], [2, 0, 0])


def test_calibrate_with_one_tag_finds_focal():
    found = calibrate(FOLDER, sightings(ONE, cameras(20, tilt=45, distance=0.35)), None)
    assert abs(found.lens.fx / LENS.fx - 1) < 0.015
    assert set(found.dropped.values()) <= {"no tag found"} and found.rms < 0.2


def test_calibrate_with_unknown_layout_finds_lens():
    found = calibrate(FOLDER, sightings(SIX, cameras(15)), None)
    assert abs(found.lens.fx / LENS.fx - 1) < 0.0015
    assert abs(found.lens.distortion[0] + 0.2) < 0.01
    assert 0 < found.deviations["focal"] < 3
    assert found.warnings == []


def test_calibrate_with_few_photos_frees_few_parameters():
    found = calibrate(FOLDER, sightings(SIX, cameras(3)), None)
    assert not any(found.lens.distortion) and set(found.deviations) == {"focal"}
    straight = replace(LENS, distortion=Distortion(), cx=512.0, cy=384.0)
    many = calibrate(FOLDER, sightings(SIX, cameras(10), straight), None)
    assert max(abs(k) for k in many.lens.distortion) < 0.02


def test_calibrate_with_contradicting_photo_drops_it():
    seen = sightings(SIX, cameras(9))
    shifted = {
        tag: Mark(SIZE * SQUARE, m.pixels + [30 * (tag % 2), 25 * (tag % 3)]) for tag, m in seen[7].marks.items()
    }
    seen[7] = replace(seen[7], marks=shifted)
    seen[3] = replace(seen[3], marks={})
    found = calibrate(FOLDER, seen, None)
    assert sorted(found.dropped) == ["003.png", "007.png"]
    assert "reprojection error" in found.dropped["007.png"] and found.dropped["003.png"] == "no tag found"
    assert abs(found.lens.fx / LENS.fx - 1) < 0.005


def test_calibrate_with_half_hidden_tag_drops_the_tag():
    seen = sightings(SIX, cameras(9))
    hidden = seen[7].marks[2].pixels + np.array([[30.0, 20.0], [0, 0], [0, 0], [0, 0]])
    seen[7] = replace(seen[7], marks=seen[7].marks | {2: Mark(SIZE * SQUARE, hidden)})
    found = calibrate(FOLDER, seen, None)
    assert found.dropped == {} and len(found.used) == 9
    assert sorted(found.used[7].marks) == [0, 1, 3, 4, 5]
    assert found.rms < 0.2


def test_calibrate_with_too_few_or_frontal_photos_raises():
    with pytest.raises(InputError, match="2 photos with tags of 5, expected at least 3"):
        two, none = sightings(SIX, cameras(2)), sightings(SIX, cameras(3))
        calibrate(FOLDER, [*two, *(replace(s, marks={}) for s in none)], None)
    with pytest.raises(InputError, match="tilt the camera by 20 to 45 degrees"):
        calibrate(FOLDER, sightings(SIX, cameras(4, tilt=1.0), noise=0.5), None)


def test_calibrate_with_small_coverage_warns():
    far = Intrinsics(1024, 768, 900.0, 900.0, 512.0, 384.0)
    found = calibrate(FOLDER, sightings(SIX, cameras(6, distance=1.2), far), None)
    assert any("of the picture" in text for text in found.warnings)
