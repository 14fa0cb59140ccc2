"""Synthetic captures against projection, the ray tracer, and what the detector finds in them."""

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.cameras import Rays
from nerf_lightning.capture.poses.geometry import inverse, normalised, project
from nerf_lightning.capture.synthetic import Flaws, object_cameras, render_photo, sheet_cameras, write_capture
from nerf_lightning.capture.tabletop import INK, PAPER, SHADE, WALL, Tabletop
from nerf_lightning.capture.tags.layout import TagLayout, flat_pose
from nerf_lightning.capture.viewpoints import ELEVATIONS, in_frame, tags_in_view
from nerf_lightning.dataset.bricks.trace import trace
from nerf_lightning.dataset.lens import Lens, rectify
from nerf_lightning.errors import InputError

SHEET = TagLayout(
    "DICT_4X4_50", 0.06, {3 * r + c: flat_pose(0.09 * (c - 1), 0.045 - 0.09 * r) for r in range(2) for c in range(3)}
)
LENS = Lens(320, 240, 290.0, 292.0, 163.0, 118.0, (-0.25, 0.08, 0.001, -0.0015, -0.01))
PINHOLE = Lens(320, 240, 290.0, 292.0, 163.0, 118.0)
EXACT = Flaws(blur=0, noise=0)
SMALL = Lens(64, 48, 58.0, 58.0, 32.0, 24.0)


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
    """Corners by tag, pixel centres at +0.5."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)
    corners, ids, _ = detector.detectMarkers(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY))
    ids = [] if ids is None else np.asarray(ids).reshape(-1)
    return {int(tag): np.asarray(four).reshape(4, 2) + 0.5 for tag, four in zip(ids, corners, strict=True)}


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
    # Both smoothed, for the one is interpolated and the other is not.
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
    quarters = np.floor(np.arctan2(poses[:, 1, 3], poses[:, 0, 3]) / (np.pi / 2)).astype(int) + 2
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
    with pytest.raises(InputError, match="two tags"):
        object_cameras(apart, LENS, 1, 0)
    tilted = flat_pose(0, 0)[[0, 2, 1, 3]]
    with pytest.raises(InputError, match="plane z = 0"):
        Tabletop(TagLayout("DICT_4X4_50", 0.02, {0: tilted}))


def test_cameras_follow_their_seed():
    for cameras in (sheet_cameras, object_cameras):
        first, again, other = (cameras(SHEET, LENS, 3, seed) for seed in (1, 1, 2))
        np.testing.assert_array_equal(first, again)
        assert np.abs(first - other).max() > 0.01


def test_noise_has_its_size_and_follows_its_seed():
    c2w = above(0, 0, 0.4)
    clean = render_photo(SHEET, SMALL, c2w, False, EXACT, 5).astype(float)
    noisy = render_photo(SHEET, SMALL, c2w, False, Flaws(blur=0, noise=4), 5)
    difference = noisy - clean
    # Rounding adds a little.
    assert difference.std() == pytest.approx(4, rel=0.05)
    assert abs(difference.mean()) < 0.15
    channels = np.corrcoef(difference.reshape(-1, 3).T)
    assert np.abs(channels - np.eye(3)).max() < 0.08
    np.testing.assert_array_equal(noisy, render_photo(SHEET, SMALL, c2w, False, Flaws(blur=0, noise=4), 5))
    assert (noisy != render_photo(SHEET, SMALL, c2w, False, Flaws(blur=0, noise=4), 6)).mean() > 0.5


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


def test_exposure_multiplies_whole_photos():
    c2w = above(0, 0, 0.4)
    clean = render_photo(SHEET, SMALL, c2w, False, EXACT, 0).astype(float)
    dark = clean < 160  # never cut off at 255
    gains = []
    for seed in range(8):
        photo = render_photo(SHEET, SMALL, c2w, False, Flaws(blur=0, noise=0, exposure=0.5), seed)
        gain = photo[dark].sum() / clean[dark].sum()
        np.testing.assert_allclose(photo[dark], gain * clean[dark], atol=1.5)
        gains.append(gain)
    assert min(gains) > 0.66 and max(gains) < 1.51 and max(gains) / min(gains) > 1.2


def test_fingers_cover_part_of_a_share_of_the_photos():
    c2w = above(0, 0, 0.4)
    clean = render_photo(SHEET, SMALL, c2w, False, EXACT, 0)
    covered = [
        (render_photo(SHEET, SMALL, c2w, False, Flaws(blur=0, noise=0, occluded=0.5), seed) != clean).any(-1)
        for seed in range(24)
    ]
    shares = np.array([mask.mean() for mask in covered])
    assert 6 <= (shares > 0).sum() <= 18
    assert (shares[shares > 0] > 0.01).all() and shares.max() < 0.3
    for mask in covered:
        border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
        assert border.any() == mask.any()


def test_beyond_the_table_there_is_a_plain_wall():
    up = np.diag([1.0, 1.0, 1.0, 1.0])
    up[2, 3] = 0.3  # looks at the sky
    photo = render_photo(SHEET, SMALL, up, True, EXACT, 0)
    assert (photo == round(255 * WALL)).all()


def test_a_capture_is_written_with_its_truth(tmp_path):
    lens = Lens(64, 48, 58.0, 58.0, 32.0, 24.0, (-0.2, 0.05, 0.0, 0.0, 0.0))
    flaws = Flaws(exposure=0.1, occluded=0.5)
    truth = write_capture(tmp_path / "a", SHEET, lens, 2, 3, flaws, seed=4)
    assert (truth.lens, truth.layout) == (lens, SHEET)
    assert list(truth.calibration) == ["000.png", "001.png"] and list(truth.photos) == ["000.png", "001.png", "002.png"]
    for kind, poses in (("calibration", truth.calibration), ("photos", truth.photos)):
        assert sorted(file.name for file in (tmp_path / "a" / kind).iterdir()) == list(poses)
        for name, c2w in poses.items():
            photo = imageio.imread(tmp_path / "a" / kind / name)
            assert photo.shape == (48, 64, 3) and photo.dtype == np.uint8
            if kind == "calibration":
                exact = render_photo(SHEET, lens, c2w, False, Flaws(noise=0), 0)
                assert np.median(np.abs(photo.astype(float) - exact)) < 25
    write_capture(tmp_path / "b", SHEET, lens, 2, 3, flaws, seed=4)
    write_capture(tmp_path / "c", SHEET, lens, 2, 3, flaws, seed=5)
    for file in (tmp_path / "a").rglob("*.png"):
        name = file.relative_to(tmp_path / "a")
        assert file.read_bytes() == (tmp_path / "b" / name).read_bytes()
        assert file.read_bytes() != (tmp_path / "c" / name).read_bytes()
