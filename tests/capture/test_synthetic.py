"""Synthetic captures against projection, the ray tracer, and what the detector finds in them."""

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from capture.views import SIX as SHEET

from benchmarks.synthetic.photos import Flaws, render_photo, write_capture
from benchmarks.synthetic.tabletop import INK, PAPER, SHADE, WALL, Tabletop
from benchmarks.synthetic.viewpoints import ELEVATIONS, in_frame, object_cameras, sheet_cameras, tags_in_view
from nerf_lightning.cameras import Rays
from nerf_lightning.capture.poses.geometry import inverse, normalised, project
from nerf_lightning.capture.tags.detect import tag_detector
from nerf_lightning.capture.tags.layout import TagLayout, flat_pose
from nerf_lightning.dataset.bricks.trace import trace
from nerf_lightning.dataset.lens import Lens, rectify

LENS = Lens(320, 240, 290.0, 292.0, 163.0, 118.0, (-0.25, 0.08, 0.001, -0.0015, -0.01))
EXACT = Flaws(blur=0, noise=0)
TINY = Lens(64, 48, 58.0, 58.0, 32.0, 24.0)
MIDDLE = np.array([0.09, -0.045])
"""Of the sheet, metres."""


@pytest.fixture(scope="module")
def sheet_poses():
    return sheet_cameras(SHEET, LENS, 5, seed=3)


@pytest.fixture(scope="module")
def sheet_photos(sheet_poses):
    return [render_photo(SHEET, LENS, c2w, False, EXACT, 0) for c2w in sheet_poses]


@pytest.fixture(scope="module")
def object_poses():
    return object_cameras(SHEET, LENS, 12, seed=1)


def detected(photo):
    marks = tag_detector("DICT_4X4_50", SHEET.size)(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
    return {tag: mark.pixels for tag, mark in marks.items()}


def above(x, y, height):
    """A camera that looks straight down, the top of its picture being +y."""
    c2w = np.diag([1.0, -1.0, -1.0, 1.0])
    c2w[:3, 3] = x, y, height
    return c2w


def test_detected_corners_lie_where_projection_says(sheet_poses, sheet_photos):
    errors = []
    for c2w, photo in zip(sheet_poses, sheet_photos, strict=True):
        found = detected(photo)
        assert set(found) == set(SHEET.poses)
        errors += [found[tag] - project(LENS, inverse(c2w), SHEET.corners(tag)) for tag in found]
    errors = np.concatenate(errors)
    assert np.linalg.norm(errors, axis=-1).mean() < 0.25
    assert np.abs(errors.mean(0)).max() < 0.05


@pytest.mark.parametrize("share", [0.25, 0.5, 0.75])
def test_a_pixel_is_as_dark_as_the_share_of_it_that_is_ink(share):
    # One metre above the paper a pixel is 1 mm wide, and the principal point is a pixel's corner.
    lens = Lens(40, 30, 1000.0, 1000.0, 20.0, 15.0)
    edge = SHEET.corners(0)[0, :2]  # the printed top left
    # The tag's left edge comes to lie at x = 20 + 1 - share, its top edge at y = 15 + 1 - share.
    shift = (1 - share) / 1000
    photo = render_photo(SHEET, lens, above(edge[0] - shift, edge[1] + shift, 1.0), False, EXACT, 0) / 255
    mixed = share * INK + (1 - share) * PAPER
    tolerance = (PAPER - INK) / 18 + 1 / 255
    assert photo[20, 19] == pytest.approx(PAPER, abs=1 / 255)
    assert photo[20, 20] == pytest.approx(mixed, abs=tolerance)
    assert photo[20, 21] == pytest.approx(INK, abs=1 / 255)
    assert photo[14, 25] == pytest.approx(PAPER, abs=1 / 255)
    assert photo[15, 25] == pytest.approx(mixed, abs=tolerance)
    assert photo[16, 25] == pytest.approx(INK, abs=1 / 255)


@pytest.mark.parametrize("dictionary", ["DICT_4X4_50", "DICT_6X6_50", "DICT_APRILTAG_36h11"])
def test_tags_are_printed_as_opencv_draws_them(dictionary):
    layout = TagLayout(dictionary, 0.06, {7: flat_pose(0.2, -0.1, 90.0)})
    family = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    side = family.markerSize + 2
    # Turned counterclockwise by a quarter, its printed right is the world's +y; rows of the picture run to the world's +x.
    centres = ((np.arange(side) + 0.5) / side - 0.5) * layout.size
    x, y = np.meshgrid(0.2 + centres, -0.1 + centres, indexing="ij")
    grey = Tabletop(layout).ground(np.stack([x, y], axis=-1).reshape(-1, 2))[:, 0].reshape(side, side)
    np.testing.assert_array_equal(grey, np.where(cv2.aruco.generateImageMarker(family, 7, side) > 127, PAPER, INK))


def test_distortion_is_that_of_the_lens(sheet_poses, sheet_photos):
    flat = rectify(LENS)
    pinhole = Lens(320, 240, *flat.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    # Smoothed, because one is interpolated and the others are not.
    pictures = [
        cv2.GaussianBlur(picture, (0, 0), 2.0).astype(float)
        for picture in (
            flat.apply(sheet_photos[0]),
            render_photo(SHEET, pinhole, sheet_poses[0], False, EXACT, 0),
            sheet_photos[0],
        )
    ]
    inner = np.s_[8:-8, 8:-8]
    undone, expected, distorted = (picture[inner] for picture in pictures)
    assert np.abs(undone - expected).mean() < 0.5
    assert np.abs(distorted - expected).mean() > 5


def test_the_object_is_the_traced_one_and_hides_what_is_behind(object_poses):
    top, c2w = Tabletop(SHEET), object_poses[0]
    rng = np.random.default_rng(0)
    pixels = rng.uniform(0, 1, (2000, 2)) * (LENS.width, LENS.height)
    rays = np.pad(normalised(LENS, pixels), ((0, 0), (0, 1)), constant_values=1) @ c2w[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = (c2w[:3, 3] - top.shift) / top.scale
    rgb, hit, _ = trace(Rays(torch.from_numpy(eye).expand(len(rays), 3).float(), torch.from_numpy(rays).float()))
    rgb, hit = rgb.numpy(), hit.numpy()
    assert 0.05 < hit.mean() < 0.6
    colours, empty = top.colours(c2w[:3, 3], rays, True), top.colours(c2w[:3, 3], rays, False)
    # Single precision crosses an edge of a solid or a pattern now and then.
    assert (np.abs(colours[hit] - rgb[hit]).max(-1) < 0.01).mean() > 0.97
    changed = (colours != empty).any(-1)
    shaded = changed & ~hit
    np.testing.assert_allclose(colours[shaded], SHADE * empty[shaded])
    assert 0.005 < shaded.mean() < hit.mean()
    # All of it within the box around it.
    ends = c2w[:3, 3] + 10 * rays
    assert top.in_front(c2w[:3, 3], ends)[hit].all()


def test_tags_under_the_object_are_gone(object_poses):
    assert Tabletop(SHEET).free_tags == {0, 2, 3, 5}
    c2w = object_poses[0]
    whole = {tag for tag in SHEET.poses if in_frame(LENS, c2w, SHEET.corners(tag)).all()}
    assert whole & {1, 4}
    assert whole <= set(detected(render_photo(SHEET, LENS, c2w, False, EXACT, 0)))
    photo = render_photo(SHEET, LENS, c2w, True, EXACT, 0)
    found = set(detected(photo))
    assert not found & {1, 4}
    assert set(tags_in_view(Tabletop(SHEET), LENS, c2w)) <= found


def test_an_object_as_large_as_the_sheet_stands_beside_it():
    top = Tabletop(TagLayout("DICT_4X4_50", 0.06, {3: flat_pose(0, 0)}))
    assert top.free_tags == {3}
    assert top.box[0, 1] > top.paper[1, 1]
    np.testing.assert_allclose(top.box[1, 1] - top.box[0, 1], 0.12)
    assert top.box[0, 2] == 0
    # From behind the object the tag is hidden, from above it is not.
    corners = top.layout.corners(3)
    assert top.in_front(np.array([0.0, 0.5, 0.1]), corners).all()
    assert not top.in_front(np.array([0.0, 0.0, 0.5]), corners).any()


def test_sheet_cameras_show_all_tags_from_all_sides():
    poses = sheet_cameras(SHEET, LENS, 20, seed=0)
    corners = np.concatenate([SHEET.corners(tag) for tag in SHEET.poses])
    pixels = np.array([project(LENS, inverse(c2w), corners) for c2w in poses])
    assert all(in_frame(LENS, c2w, corners).all() for c2w in poses)
    tilts = np.degrees(np.arccos(np.clip(-poses[:, 2, 2], -1, 1)))
    assert tilts.max() > 35 and tilts.min() < 15
    # The sheet is seen from all sides: each quarter has a fair share.
    quarters = np.floor(np.arctan2(*(poses[:, :2, 3] - MIDDLE).T[::-1]) / (np.pi / 2)).astype(int) + 2
    assert (np.bincount(quarters, minlength=4) >= 3).all()
    # Over all photos the corners fill the frame, out to its corners.
    for corner in ((0, 0), (320, 0), (0, 240), (320, 240)):
        assert np.linalg.norm(pixels - corner, axis=-1).min() < 75  # but for the white rim
    # A tag is large enough to be read.
    sides = np.linalg.norm(pixels.reshape(20, 6, 4, 2) - np.roll(pixels.reshape(20, 6, 4, 2), 1, axis=2), axis=-1)
    assert sides.min() > 14


def test_object_cameras_go_around_with_object_and_tags_in_view(object_poses):
    top = Tabletop(SHEET)
    centre = top.box.mean(0)
    offset = object_poses[:, :3, 3] - centre
    turns = np.degrees(np.unwrap(np.arctan2(offset[:, 1], offset[:, 0])))
    assert (np.diff(turns) > 0).all() and turns[-1] - turns[0] == pytest.approx(330, abs=20)
    heights = np.degrees(np.arcsin(offset[:, 2] / np.linalg.norm(offset, axis=-1)))
    assert heights.min() > ELEVATIONS[0] - 12 and heights.max() < ELEVATIONS[1] + 12 and np.ptp(heights) > 20
    for c2w in object_poses:
        assert np.linalg.norm(project(LENS, inverse(c2w), centre[None]) - [163, 118]) < 60
        assert len(tags_in_view(top, LENS, c2w)) >= 2
    assert len(object_cameras(TagLayout("DICT_4X4_50", 0.06, {0: flat_pose(0, 0)}), LENS, 4, 0)) == 4


def test_layouts_that_cannot_be_photographed_are_refused():
    apart = TagLayout("DICT_4X4_50", 0.02, {0: flat_pose(0, 0), 1: flat_pose(9, 0)})
    with pytest.raises(ValueError, match="two tags"):
        object_cameras(apart, LENS, 1, 0)
    tilted = flat_pose(0, 0)[[0, 2, 1, 3]]
    with pytest.raises(ValueError, match="plane z = 0"):
        Tabletop(TagLayout("DICT_4X4_50", 0.02, {0: tilted}))


def test_noise_has_its_size():
    c2w = above(*MIDDLE, 0.4)
    clean = render_photo(SHEET, TINY, c2w, False, EXACT, 5).astype(float)
    noisy = render_photo(SHEET, TINY, c2w, False, Flaws(blur=0, noise=4), 5)
    difference = noisy - clean
    # Rounding adds a little.
    assert difference.std() == pytest.approx(4, rel=0.05)
    assert abs(difference.mean()) < 0.15
    channels = np.corrcoef(difference.reshape(-1, 3).T)
    assert np.abs(channels - np.eye(3)).max() < 0.08


def test_blur_spreads_an_edge_by_its_sigma():
    lens = Lens(64, 48, 1000.0, 1000.0, 32.0, 24.0)
    edge = SHEET.corners(0)[0, :2]
    c2w = above(edge[0], edge[1] - 0.005, 1.0)  # paper on the left half, the tag's border on the right
    for sigma in (1.0, 2.0):
        row = render_photo(SHEET, lens, c2w, False, Flaws(blur=sigma, noise=0), 0)[24, 20:44, 0].astype(float)
        spread = -np.diff(row).clip(max=0) / 255 / (PAPER - INK)
        place = np.arange(len(spread)) + 21 - 32
        middle = (spread * place).sum() / spread.sum()
        assert middle == pytest.approx(0, abs=0.05)
        assert np.sqrt((spread * (place - middle) ** 2).sum() / spread.sum()) == pytest.approx(sigma, rel=0.1)


def test_beyond_the_table_there_is_a_plain_wall():
    up = np.diag([1.0, 1.0, 1.0, 1.0])
    up[2, 3] = 0.3  # looks at the sky
    photo = render_photo(SHEET, TINY, up, True, EXACT, 0)
    assert (photo == round(255 * WALL)).all()


def test_a_capture_is_written_with_its_truth_and_follows_its_seed(tmp_path):
    lens = Lens(32, 24, 29.0, 29.0, 16.0, 12.0)
    truth, _, other = (
        write_capture(tmp_path / name, SHEET, lens, 2, 1, Flaws(), seed)
        for name, seed in (("a", 4), ("b", 4), ("c", 5))
    )
    assert (truth.lens, truth.layout) == (lens, SHEET)
    assert list(truth.calibration) == ["000.png", "001.png"] and list(truth.photos) == ["000.png"]
    for kind, poses in (("calibration", truth.calibration), ("photos", truth.photos)):
        assert sorted(file.name for file in (tmp_path / "a" / kind).iterdir()) == list(poses)
        for name, c2w in poses.items():
            assert np.abs(c2w - getattr(other, kind)[name]).max() > 0.01
            first, again, changed = (tmp_path / folder / kind / name for folder in "abc")
            assert first.read_bytes() == again.read_bytes() != changed.read_bytes()
            exact = render_photo(SHEET, lens, c2w, kind == "photos", Flaws(noise=0), 0)
            assert np.abs(imageio.imread(first).astype(float) - exact).mean() < 3
