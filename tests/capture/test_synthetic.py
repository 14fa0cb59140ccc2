"""Synthetic captures against projection, the ray tracer, and what the detector finds in them."""

import cv2
import numpy as np
import pytest

from benchmarks.synthetic.photos import Flaws, render_photo
from benchmarks.synthetic.tabletop import INK, PAPER, Tabletop
from benchmarks.synthetic.viewpoints import sheet_cameras
from nerf_lightning.cameras import Distortion
from nerf_lightning.capture.poses.geometry import inverse, project
from nerf_lightning.capture.tags.detect import tag_detector
from nerf_lightning.capture.tags.layout import TagLayout, flat_pose
from nerf_lightning.dataset.intrinsics import Intrinsics
from tests.helpers.tag_views import SIX as SHEET

LENS = Intrinsics(320, 240, 290.0, 292.0, 163.0, 118.0, Distortion(k1=-0.25, k2=0.08, p1=0.001, p2=-0.0015, k3=-0.01))
EXACT = Flaws(blur=0, noise=0)


def detect(photo):
    marks = tag_detector("DICT_4X4_50", SHEET.size)(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
    return {tag: mark.pixels for tag, mark in marks.items()}


def look_down(x, y, height):
    """A camera that looks straight down, the top of its picture being +y."""
    c2w = np.diag([1.0, -1.0, -1.0, 1.0])
    c2w[:3, 3] = x, y, height
    return c2w


def test_render_photo_of_sheet_shows_corners_where_they_project():
    errors = []
    for c2w in sheet_cameras(SHEET, LENS, 3, seed=3):
        found = detect(render_photo(SHEET, LENS, c2w, False, EXACT, 0))
        assert set(found) == set(SHEET.poses)
        errors += [found[tag] - project(LENS, inverse(c2w), SHEET.corners(tag)) for tag in found]
    errors = np.concatenate(errors)
    assert np.linalg.norm(errors, axis=-1).mean() < 0.25 and np.abs(errors.mean(0)).max() < 0.05


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_render_photo_pixel_is_as_dark_as_its_share_of_ink(share):
    # One metre above the paper a pixel is 1 mm wide, and the principal point is a pixel's corner.
    lens = Intrinsics(40, 30, 1000.0, 1000.0, 20.0, 15.0)
    edge = SHEET.corners(0)[0, :2]  # the printed top left
    # The tag's left edge comes to lie at x = 20 + 1 - share, its top edge at y = 15 + 1 - share.
    shift = (1 - share) / 1000
    photo = render_photo(SHEET, lens, look_down(edge[0] - shift, edge[1] + shift, 1.0), False, EXACT, 0) / 255
    mixed = pytest.approx(share * INK + (1 - share) * PAPER, abs=(PAPER - INK) / 18 + 1 / 255)
    assert photo[20, 19] == pytest.approx(PAPER, abs=1 / 255) and photo[20, 20] == mixed
    assert photo[14, 25] == pytest.approx(PAPER, abs=1 / 255) and photo[15, 25] == mixed
    assert photo[20, 21] == pytest.approx(INK, abs=1 / 255) and photo[16, 25] == pytest.approx(INK, abs=1 / 255)


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_APRILTAG_36h11"])
def test_tabletop_prints_tags_as_opencv_draws_them(dictionary):
    layout = TagLayout(dictionary, 0.06, {7: flat_pose(0.2, -0.1, 90.0)})
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    side = family.markerSize + 2
    # Turned counterclockwise by a quarter, its printed right is the world's +y; rows of the picture run to the world's +x.
    centres = ((np.arange(side) + 0.5) / side - 0.5) * layout.size
    x, y = np.meshgrid(0.2 + centres, -0.1 + centres, indexing="ij")
    grey = Tabletop(layout).ground(np.stack([x, y], axis=-1).reshape(-1, 2))[:, 0].reshape(side, side)
    np.testing.assert_array_equal(grey, np.where(cv2.aruco.generateImageMarker(family, 7, side) > 127, PAPER, INK))
