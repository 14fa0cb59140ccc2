"""The report's pictures of a small capture whose corners are known."""

from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from benchmarks.synthetic.viewpoints import in_frame, object_cameras, sheet_cameras
from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.photo_status import PhotoStatus, calibration_statuses, photo_statuses, subsample_photos
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import inverse, project
from nerf_lightning.capture.poses.solve import solve
from nerf_lightning.capture.report.coverage_chart import displacement
from nerf_lightning.capture.report.error_chart import collect_residuals
from nerf_lightning.capture.report.write import write_report
from nerf_lightning.capture.run import Capture, PlacedPhoto
from nerf_lightning.capture.tags.detect import Mark, Sighting
from nerf_lightning.capture.tags.layout import SQUARE
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.drawing.ink import magnification, readable, shortened
from tests.helpers.tag_views import SIX as SHEET

LENS = Intrinsics(320, 240, 290.0, 290.0, 160.0, 120.0, Distortion(k1=-0.2))
TURNED = "240x320 pixels, held the other way: 320x240 is what was calibrated"


def write_grey(path, width=320, height=240):
    path.parent.mkdir(exist_ok=True)
    imageio.imwrite(path, np.full((height, width, 3), 128, np.uint8))
    return path


def detect(path, c2w, rng):
    """What a detector would find in a photo from there, give or take a fifth of a pixel."""
    marks = {}
    for tag in SHEET.poses:
        if in_frame(LENS, c2w, SHEET.corners(tag)).all():
            pixels = project(LENS, inverse(c2w), SHEET.corners(tag)) + 0.2 * rng.standard_normal((4, 2))
            marks[tag] = Mark(SHEET.size * SQUARE, pixels)
    return Sighting(write_grey(path), 320, 240, marks)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Six photos of the sheet, one without tags, one held the other way; the same of the object."""
    folder, rng = tmp_path_factory.mktemp("photos"), np.random.default_rng(0)
    poses = {"sheet": sheet_cameras(SHEET, LENS, 6, seed=1), "object": object_cameras(SHEET, LENS, 6, seed=2)}
    seen = {
        kind: [detect(folder / kind / f"{kind}{i} $a_<b>.png", c2w, rng) for i, c2w in enumerate(c2ws)]
        + [Sighting(write_grey(folder / kind / f"blank-{kind}.png"), 320, 240, {})]
        for kind, c2ws in poses.items()
    }
    for kind in poses:
        write_grey(folder / kind / f"turned-{kind}.png", 240, 320)
    found = calibrate(folder / "sheet", seen["sheet"], None)
    found.dropped["turned-sheet.png"] = TURNED
    solved = solve(found.lens, [s.marks for s in seen["object"]], None)
    c2w = np.stack([inverse(solved.w2c[i]) for i in range(6)])
    paths = [s.path for s in seen["object"][:6]]
    photos = [
        PlacedPhoto(path.name, "", pose, float(error))
        for path, pose, error in zip(paths, c2w, solved.refined.rms, strict=True)
    ]
    photos += [PlacedPhoto("blank-object.png", "no tag found"), PlacedPhoto("turned-object.png", TURNED)]
    scene = pack(paths, c2w, found.lens, "small", "tests", longest=64)
    return Capture(found, seen["object"], solved, photos, scene)


def test_write_report_writes_four_pictures(capture, tmp_path):
    files = write_report(capture, tmp_path / "report")
    assert [file.name for file in files] == ["tags.png", "errors.png", "coverage.png", "cameras.png"]
    assert sorted((tmp_path / "report").iterdir()) == sorted(files)
    for file in files:
        picture = imageio.imread(file)
        assert picture.ndim == 3 and min(picture.shape[:2]) > 600 and max(picture.shape[:2]) < 6000
        assert picture.std() > 5  # not a blank page


def test_write_report_of_missing_photo_names_it_and_leaves_nothing(capture, tmp_path):
    gone = replace(capture, photos=[*capture.photos, PlacedPhoto("gone.png", "no tag found")])
    with pytest.raises(ValueError, match="gone.png"):
        write_report(gone, tmp_path)
    assert not list(tmp_path.iterdir())


def test_photo_statuses_hold_residuals_of_their_own_photo(capture):
    statuses, solved = photo_statuses(capture), capture.solved
    assert [s.number for s in statuses] == list(range(1, 9))
    for i, (status, placed) in enumerate(zip(statuses[:6], capture.photos[:6], strict=True)):
        assert status.path.is_file() and status.path.name == placed.name
        assert status.error == pytest.approx(placed.reprojection_px)
        for tag, rest in status.residuals.items():
            again = project(solved.lens, solved.w2c[i] @ solved.tags[tag], status.marks[tag].points)
            np.testing.assert_allclose(status.marks[tag].pixels + rest, again, atol=0.5)
        squares = np.concatenate(list(status.residuals.values())) ** 2
        assert status.error == pytest.approx(np.sqrt(squares.sum(1).mean()))
    assert all(status.error is None and not status.residuals for status in statuses[6:])


def test_subsample_photos_keeps_those_left_out():
    photos = [
        PhotoStatus(n, Path("x.png"), {}, {}, 0.1, "blurred" if n in (17, 18, 120) else "") for n in range(1, 201)
    ]
    assert subsample_photos(photos[:24], 24) == photos[:24]
    numbers = [s.number for s in subsample_photos(photos, 24)]
    assert len(numbers) == 24 and numbers == sorted(numbers) and {17, 18, 120} <= set(numbers)
    assert max(np.diff([n for n in numbers if n not in (17, 18, 120)])) <= 12


def test_collect_residuals_counts_used_photos_alone(capture):
    statuses = calibration_statuses(capture)
    seen, residuals = collect_residuals(statuses)
    assert len(seen) == len(residuals) == sum(4 * len(s.marks) for s in statuses)
    assert np.sqrt((residuals**2).sum(1).mean()) == pytest.approx(capture.calibration.rms)
    assert collect_residuals([s for s in statuses if s.reason])[0].shape == (0, 2)


def test_displacement_is_the_lens_polynomial():
    lens = Intrinsics(200, 100, 100.0, 100.0, 100.0, 50.0, Distortion(k1=-0.1))
    # At a tangent of 1, k1 pulls in by a tenth: 10 pixels at a focal length of 100.
    moved = displacement(lens, np.array([[200.0, 50.0], [100.0, 50.0]]))
    np.testing.assert_allclose(moved, [[-10, 0], [0, 0]], atol=1e-9)


def test_ink_magnification_takes_round_steps_and_names_stay_readable():
    assert [magnification(1.0, target) for target in (0.5, 2.0, 4.9, 5.0, 99.0)] == [1, 2, 2, 5, 50]
    assert readable("Grüße $1$ \u5bb6\n.png") == "Grüße $1$ ??.png"
    assert shortened("abcdefghijk", 10) == "abcd…ghijk"
