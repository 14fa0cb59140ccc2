from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import angle_between, inverse, project
from nerf_lightning.capture.poses.solve import place_tags, solve, solve_without_misfits
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.capture.tags.layout import SQUARE
from nerf_lightning.errors import InputError
from tests.helpers.tag_views import LENS, ONE, SIX, SIZE, cameras, sightings

FOLDER = Path("calibration")


def worst_tag(tags: dict[int, np.ndarray], reference: int) -> float:
    """Metres between where a tag lies and where it was found, in the frame of the reference tag."""
    home = inverse(SIX.poses[reference])
    return max(float(np.linalg.norm((home @ SIX.poses[tag])[:3, 3] - pose[:3, 3])) for tag, pose in tags.items())


def test_solve_of_unknown_layout_finds_tags_and_cameras():
    c2w = cameras(10)
    solved = solve(LENS, sightings(SIX, c2w), None)
    assert sorted(solved.tags) == list(range(6)) and len(solved.w2c) == 10
    (reference,) = (tag for n, tag in enumerate(solved.tags) if n in solved.fixed)
    assert np.array_equal(solved.tags[reference], np.eye(4))
    assert worst_tag(solved.tags, reference) < 3e-4
    truth = [inverse(pose) @ SIX.poses[reference] for pose in c2w]
    off = [angle_between(*pair) for pair in zip(solved.w2c.values(), truth, strict=True)]
    assert np.median(off) < np.radians(0.1)
    known = solve(LENS, sightings(SIX, c2w), SIX.poses)  # keeps its frame
    for w2c, exact in zip(known.w2c.values(), c2w, strict=True):
        assert np.abs(inverse(w2c) - exact).max() < 3e-3


def test_solve_without_misfits_leaves_out_unlinked_photos():
    seen = sightings(SIX, cameras(6))
    seen[1] = replace(seen[1], marks={})
    seen[4] = replace(seen[4], marks={17: seen[4].marks[0]})  # a tag that no other photo shows
    solved, photos = solve_without_misfits(seen, {}, lambda left: solve(LENS, left, None))
    assert solved.photos == ("000.png", "002.png", "003.png", "005.png")
    assert photos[1].reason == "no tag found" and "not linked" in photos[4].reason
    for i, photo in enumerate(photos):
        assert photo.name == seen[i].name and (photo.c2w is None) == bool(photo.reason)
        for tag, rest in photo.residuals.items():
            again = project(LENS, inverse(photo.c2w) @ solved.tags[tag], seen[i].marks[tag].points)
            np.testing.assert_allclose(seen[i].marks[tag].pixels + rest, again, atol=0.2)
        if photo.residuals:
            squares = np.concatenate(list(photo.residuals.values())) ** 2
            assert photo.reprojection_px == pytest.approx(np.sqrt(squares.sum(1).mean()))
    with pytest.raises(InputError, match="tags that fit no camera"):
        solve(LENS, [seen[1]], None)


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
    assert abs(found.lens.distortion.k1 + 0.2) < 0.01
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
