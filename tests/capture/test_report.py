"""The report's pictures of a small capture whose corners are known."""

from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from benchmarks.synthetic.viewpoints import in_frame, object_cameras, sheet_cameras
from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.place import place_photos
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import inverse, project
from nerf_lightning.capture.poses.solve import PlacedPhoto
from nerf_lightning.capture.report.charts import collect_residuals
from nerf_lightning.capture.report.contact_sheet import subsample_photos
from nerf_lightning.capture.report.write import write_report
from nerf_lightning.capture.run import Capture
from nerf_lightning.capture.tags.detect import Mark, Sighting
from nerf_lightning.capture.tags.layout import SQUARE
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.drawing.ink import magnification, readable, shortened
from tests.helpers.tag_views import SIX as SHEET

LENS = Intrinsics(320, 240, 290.0, 290.0, 160.0, 120.0, Distortion(k1=-0.2))


def write_grey(path, width=320, height=240):
    path.parent.mkdir(exist_ok=True)
    imageio.imwrite(path, np.full((height, width, 3), 128, np.uint8))
    return Sighting(path, width, height, {})


def detect(path, c2w, rng):
    """What a detector would find in a photo from there, give or take a fifth of a pixel."""
    marks = {}
    for tag in SHEET.poses:
        if in_frame(LENS, c2w, SHEET.corners(tag)).all():
            pixels = project(LENS, inverse(c2w), SHEET.corners(tag)) + 0.2 * rng.standard_normal((4, 2))
            marks[tag] = Mark(SHEET.size * SQUARE, pixels)
    return replace(write_grey(path), marks=marks)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Six photos of the sheet and one held the other way; the same of the object."""
    folder, rng = tmp_path_factory.mktemp("photos"), np.random.default_rng(0)
    poses = {"sheet": sheet_cameras(SHEET, LENS, 6, seed=1), "object": object_cameras(SHEET, LENS, 6, seed=2)}
    seen = {
        kind: [detect(folder / kind / f"{kind}{i} $a_<b>.png", c2w, rng) for i, c2w in enumerate(c2ws)]
        + [write_grey(folder / kind / f"turned-{kind}.png", 240, 320)]
        for kind, c2ws in poses.items()
    }
    found = calibrate(folder / "sheet", seen["sheet"], None)
    solved, photos = place_photos(folder / "object", seen["object"], found.lens, None)
    placed = [photo for photo in photos if not photo.reason]
    c2w = np.stack([photo.c2w for photo in placed])
    scene = pack([photo.sighting.path for photo in placed], c2w, found.lens, "small", "tests", longest=64)
    return Capture(found, solved, photos, scene)


def test_write_report_writes_three_pictures(capture, tmp_path):
    assert "held the other way: 320x240" in capture.photos[-1].reason
    files = write_report(capture, tmp_path / "report")
    assert [file.name for file in files] == ["tags.png", "errors.png", "cameras.png"]
    assert sorted((tmp_path / "report").iterdir()) == sorted(files)
    for file in files:
        picture = imageio.imread(file)
        assert picture.ndim == 3 and min(picture.shape[:2]) > 600 and max(picture.shape[:2]) < 6000
        assert picture.std() > 5  # not a blank page


def test_subsample_photos_keeps_those_left_out():
    photos = [
        PlacedPhoto(Sighting(Path("x.png"), 4, 3, {}), "blurred" if n in (17, 18, 120) else "") for n in range(200)
    ]
    assert subsample_photos(photos[:24], 24) == list(range(24))
    numbers = subsample_photos(photos, 24)
    assert len(numbers) == 24 and numbers == sorted(numbers) and {17, 18, 120} <= set(numbers)
    assert max(np.diff([n for n in numbers if n not in (17, 18, 120)])) <= 12


def test_collect_residuals_counts_used_photos_alone(capture):
    found = capture.calibration
    seen, residuals = collect_residuals(found.photos)
    assert len(seen) == len(residuals) == sum(4 * len(s.marks) for s in found.used)
    assert np.sqrt((residuals**2).sum(1).mean()) == pytest.approx(found.rms)


def test_ink_magnification_takes_round_steps_and_names_stay_readable():
    assert [magnification(1.0, target) for target in (0.5, 2.0, 4.9, 5.0, 99.0)] == [1, 2, 2, 5, 50]
    assert readable("Grüße $1$ \u5bb6\n.png") == "Grüße $1$ ??.png"
    assert shortened("abcdefghijk", 10) == "abcd…ghijk"
