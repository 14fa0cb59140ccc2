"""Synthetic captures against projection, the ray tracer, and what the detector finds in them."""

import cv2
import numpy as np

from benchmarks.synthetic.photos import Flaws, render_photo
from benchmarks.synthetic.viewpoints import sheet_cameras
from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.geometry import inverse, project
from nerf_lightning.capture.tags.detect import tag_detector
from nerf_lightning.dataset.intrinsics import Intrinsics
from tests.helpers.tag_views import SIX as SHEET

LENS = Intrinsics(320, 240, 290.0, 292.0, 163.0, 118.0, Distortion(k1=-0.25, k2=0.08, p1=0.001, p2=-0.0015, k3=-0.01))
EXACT = Flaws(blur=0, noise=0)


def detect(photo):
    marks = tag_detector("DICT_4X4_50", SHEET.size)(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
    return {tag: mark.pixels for tag, mark in marks.items()}


def test_render_photo_of_sheet_shows_corners_where_they_project():
    errors = []
    for c2w in sheet_cameras(SHEET, LENS, 3, seed=3):
        found = detect(render_photo(SHEET, LENS, c2w, False, EXACT, 0))
        assert set(found) == set(SHEET.poses)
        errors += [found[tag] - project(LENS, inverse(c2w), SHEET.corners(tag)) for tag in found]
    errors = np.concatenate(errors)
    assert np.linalg.norm(errors, axis=-1).mean() < 0.25 and np.abs(errors.mean(0)).max() < 0.05
