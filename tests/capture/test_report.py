"""The report's figures of a small capture."""

from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from nerf_lightning.capture.pipeline import Capture
from nerf_lightning.capture.poses.pose_solver import RegisteredPhoto
from nerf_lightning.capture.report.report import collect_residuals, write_report
from nerf_lightning.capture.report.tag_sheet import subsample_photos
from nerf_lightning.capture.tags.detect import PhotoObservation
from nerf_lightning.drawing.style import choose_magnification, replace_missing_glyphs, shorten


def test_write_report_of_capture_writes_three_images(packed: tuple[Path, Capture], tmp_path: Path):
    _, capture = packed
    files = write_report(capture, tmp_path / "report")
    assert [file.name for file in files] == ["tags.png", "errors.png", "cameras.png"]
    assert sorted((tmp_path / "report").iterdir()) == sorted(files)
    for file in files:
        picture = imageio.imread(file)
        assert picture.ndim == 3 and min(picture.shape[:2]) > 600 and max(picture.shape[:2]) < 6000
        assert picture.std() > 5  # not a blank page
    _, residuals = collect_residuals(capture.calibration.photos)
    assert np.sqrt((residuals**2).sum(1).mean()) == pytest.approx(capture.calibration.rms)


def test_subsample_photos_of_many_keeps_excluded_ones():
    photos = [
        RegisteredPhoto(PhotoObservation(Path("x.png"), 4, 3, {}), "blurred" if n in (17, 18, 120) else "")
        for n in range(200)
    ]
    assert subsample_photos(photos[:24], 24) == list(range(24))
    numbers = subsample_photos(photos, 24)
    assert len(numbers) == 24 and numbers == sorted(numbers) and {17, 18, 120} <= set(numbers)
    assert max(np.diff([n for n in numbers if n not in (17, 18, 120)])) <= 12


def test_choose_magnification_takes_round_steps_and_text_fits_font():
    assert [choose_magnification(1.0, target) for target in (0.5, 2.0, 4.9, 5.0, 99.0)] == [1, 2, 2, 5, 50]
    assert replace_missing_glyphs("Grüße $1$ \u5bb6\n.png") == "Grüße $1$ ??.png"
    assert shorten("abcdefghijk", 10) == "abcd…ghijk"
