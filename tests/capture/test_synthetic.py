"""Synthetic captures against projection, the ray tracer, and what the detector finds in them."""

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from capture.views import SIX as SHEET

from benchmarks.synthetic.photos import Flaws, render_photo, write_capture
from benchmarks.synthetic.tabletop import INK, PAPER, SHADE, Tabletop
from benchmarks.synthetic.viewpoints import ELEVATIONS, in_frame, object_cameras, sheet_cameras, tags_in_view
from nerf_lightning.cameras import Rays
from nerf_lightning.capture.poses.geometry import inverse, normalised, project
from nerf_lightning.capture.tags.detect import tag_detector
from nerf_lightning.capture.tags.layout import TagLayout, flat_pose
from nerf_lightning.dataset.bricks.trace import trace
from nerf_lightning.dataset.lens import Lens

LENS = Lens(320, 240, 290.0, 292.0, 163.0, 118.0, (-0.25, 0.08, 0.001, -0.0015, -0.01))
EXACT = Flaws(blur=0, noise=0)


@pytest.fixture(scope="module")
def object_poses():
    return object_cameras(SHEET, LENS, 12, seed=1)


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
    lens = Lens(40, 30, 1000.0, 1000.0, 20.0, 15.0)
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


def test_tabletop_object_is_the_traced_one(object_poses):
    top, c2w = Tabletop(SHEET), object_poses[0]
    pixels = np.random.default_rng(0).uniform(0, 1, (2000, 2)) * (LENS.width, LENS.height)
    rays = np.pad(normalised(LENS, pixels), ((0, 0), (0, 1)), constant_values=1) @ c2w[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = (c2w[:3, 3] - top.shift) / top.scale
    rgb, hit, _ = trace(Rays(torch.from_numpy(eye).expand(len(rays), 3).float(), torch.from_numpy(rays).float()))
    rgb, hit = rgb.numpy(), hit.numpy()
    assert 0.05 < hit.mean() < 0.6
    colours, empty = top.colours(c2w[:3, 3], rays, True), top.colours(c2w[:3, 3], rays, False)
    # Single precision crosses an edge of a solid or a pattern now and then.
    assert (np.abs(colours[hit] - rgb[hit]).max(-1) < 0.01).mean() > 0.97
    shaded = (colours != empty).any(-1) & ~hit
    np.testing.assert_allclose(colours[shaded], SHADE * empty[shaded])
    assert 0.005 < shaded.mean() < hit.mean()


def test_render_photo_with_object_hides_tags_under_it(object_poses):
    assert Tabletop(SHEET).free_tags == {0, 2, 3, 5}
    found = set(detect(render_photo(SHEET, LENS, object_poses[0], True, EXACT, 0)))
    assert not found & {1, 4} and set(tags_in_view(Tabletop(SHEET), LENS, object_poses[0])) <= found


def test_sheet_cameras_show_all_tags_from_all_sides():
    poses = sheet_cameras(SHEET, LENS, 20, seed=0)
    corners = np.concatenate([SHEET.corners(tag) for tag in SHEET.poses])
    assert all(in_frame(LENS, c2w, corners).all() for c2w in poses)
    tilts = np.degrees(np.arccos(np.clip(-poses[:, 2, 2], -1, 1)))
    assert tilts.max() > 35 and tilts.min() < 15
    quarters = np.floor(np.arctan2(*(poses[:, :2, 3] - [0.09, -0.045]).T[::-1]) / (np.pi / 2)).astype(int) + 2
    assert (np.bincount(quarters, minlength=4) >= 3).all()


def test_object_cameras_go_around_with_two_tags_in_view(object_poses):
    top = Tabletop(SHEET)
    offset = object_poses[:, :3, 3] - top.box.mean(0)
    turns = np.degrees(np.unwrap(np.arctan2(offset[:, 1], offset[:, 0])))
    assert (np.diff(turns) > 0).all() and turns[-1] - turns[0] == pytest.approx(330, abs=20)
    heights = np.degrees(np.arcsin(offset[:, 2] / np.linalg.norm(offset, axis=-1)))
    assert heights.min() > ELEVATIONS[0] - 12 and heights.max() < ELEVATIONS[1] + 12 and np.ptp(heights) > 20
    assert all(len(tags_in_view(top, LENS, c2w)) >= 2 for c2w in object_poses)


def test_write_capture_follows_its_seed_and_flaws(tmp_path):
    lens = Lens(32, 24, 29.0, 29.0, 16.0, 12.0)
    a, _, c = (
        write_capture(tmp_path / n, SHEET, lens, 2, 1, Flaws(0, 4), seed) for n, seed in (("a", 4), ("b", 4), ("c", 5))
    )
    assert list(a.calibration) == ["000.png", "001.png"] and list(a.photos) == ["000.png"]
    for kind, poses in (("calibration", a.calibration), ("photos", a.photos)):
        for name, c2w in poses.items():
            assert np.abs(c2w - getattr(c, kind)[name]).max() > 0.01
            first, again, changed = (tmp_path / folder / kind / name for folder in "abc")
            assert first.read_bytes() == again.read_bytes() != changed.read_bytes()
            exact = render_photo(SHEET, lens, c2w, kind == "photos", EXACT, 0)
            assert np.std(imageio.imread(first).astype(float) - exact) == pytest.approx(4, rel=0.1)
