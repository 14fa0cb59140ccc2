"""The report's pictures of a small capture whose corners are known."""

from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
from capture.views import SIX as SHEET
from jaxtyping import TypeCheckError

from benchmarks.synthetic.viewpoints import in_frame, object_cameras, sheet_cameras
from nerf_lightning.capture.outcome import Outcome, calibration_outcomes, photo_outcomes, thinned
from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import inverse, project
from nerf_lightning.capture.poses.solve import solve
from nerf_lightning.capture.report.contact_sheet import MOST, annotated, heading, tag_sheet
from nerf_lightning.capture.report.coverage_chart import displacement, parameters
from nerf_lightning.capture.report.error_chart import cell_means, corners_and_residuals, error_chart
from nerf_lightning.capture.report.write import tag_corners, write_report
from nerf_lightning.capture.run import Capture, Placed
from nerf_lightning.capture.tags.detect import Mark, Sighting
from nerf_lightning.capture.tags.layout import SQUARE
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.drawing.camera_map import frustum
from nerf_lightning.drawing.ink import ORANGE, SKY, magnification, pixels_of, readable, rgb, shortened

LENS = Lens(320, 240, 290.0, 290.0, 160.0, 120.0, (-0.2, 0.0, 0.0, 0.0, 0.0))
NOWHERE = Path("photo.png")
TURNED = "240x320 pixels, held the other way: 320x240 is what was calibrated"


def stub(path, width=320, height=240):
    path.parent.mkdir(exist_ok=True)
    imageio.imwrite(path, np.full((height, width, 3), 128, np.uint8))
    return path


def sighted(path, c2w, rng):
    """What a detector would find in a photo from there, give or take a fifth of a pixel."""
    marks = {}
    for tag in SHEET.poses:
        if in_frame(LENS, c2w, SHEET.corners(tag)).all():
            pixels = project(LENS, inverse(c2w), SHEET.corners(tag)) + 0.2 * rng.standard_normal((4, 2))
            marks[tag] = Mark(SHEET.size * SQUARE, pixels)
    return Sighting(stub(path), 320, 240, marks)


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """Six photos of the sheet, one without tags, one held the other way; the same of the object."""
    folder, rng = tmp_path_factory.mktemp("photos"), np.random.default_rng(0)
    poses = {"sheet": sheet_cameras(SHEET, LENS, 6, seed=1), "object": object_cameras(SHEET, LENS, 6, seed=2)}
    seen = {
        kind: [sighted(folder / kind / f"{kind}{i}.png", c2w, rng) for i, c2w in enumerate(c2ws)]
        + [Sighting(stub(folder / kind / f"blank-{kind}.png"), 320, 240, {})]
        for kind, c2ws in poses.items()
    }
    for kind in poses:
        stub(folder / kind / f"turned-{kind}.png", 240, 320)
    found = calibrate(folder / "sheet", seen["sheet"], None)
    found.dropped["turned-sheet.png"] = TURNED
    solved = solve(found.lens, [s.marks for s in seen["object"]], None)
    c2w = np.stack([inverse(solved.w2c[i]) for i in range(6)])
    photos = [
        Placed(f"object{i}.png", "", pose, float(error))
        for i, (pose, error) in enumerate(zip(c2w, solved.refined.rms, strict=True))
    ]
    photos += [
        Placed("blank-object.png", "no tag found"),
        Placed("turned-object.png", TURNED),
    ]
    scene = pack([s.path for s in seen["object"][:6]], c2w, found.lens, "small", "tests", longest=64)
    return Capture(found, seen["object"], solved, photos, scene)


def test_four_pictures_are_written(capture, tmp_path):
    files = write_report(capture, tmp_path / "report")
    assert [file.name for file in files] == ["tags.png", "errors.png", "coverage.png", "cameras.png"]
    assert sorted(file.name for file in (tmp_path / "report").iterdir()) == sorted(file.name for file in files)
    for file in files:
        picture = imageio.imread(file)
        assert picture.ndim == 3 and picture.shape[2] == 3
        assert min(picture.shape[:2]) > 600 and max(picture.shape[:2]) < 6000
        assert picture.std() > 5  # not a blank page


def test_a_photo_that_is_gone_is_named_and_nothing_is_left_behind(capture, tmp_path):
    gone = replace(capture, photos=[*capture.photos, Placed("gone.png", "no tag found")])
    with pytest.raises(ValueError, match="gone.png"):
        write_report(gone, tmp_path)
    assert not list(tmp_path.iterdir())


def test_outcomes_hold_errors_and_residuals_of_their_own_photo(capture):
    outcomes = photo_outcomes(capture)
    assert [o.number for o in outcomes] == list(range(1, 9))
    solved = capture.solved
    for i, (o, placed) in enumerate(zip(outcomes[:6], capture.photos[:6], strict=True)):
        assert o.path.is_file() and o.path.name == placed.name
        assert o.error == pytest.approx(placed.reprojection_px)
        for tag, rest in o.residuals.items():
            again = project(solved.lens, solved.w2c[i] @ solved.tags[tag], o.marks[tag].points)
            # Tags may be twisted a little.
            np.testing.assert_allclose(o.marks[tag].pixels + rest, again, atol=0.5)
        squares = np.concatenate(list(o.residuals.values())) ** 2
        assert o.error == pytest.approx(np.sqrt(squares.sum(1).mean()))
    assert all(o.error is None and not o.residuals for o in outcomes[6:])


def test_captions_name_the_error_or_the_reason(capture):
    captions = {o.path.name: o.caption for o in [*calibration_outcomes(capture), *photo_outcomes(capture)]}
    assert len(captions) == 16
    for name, caption in captions.items():
        assert name in caption
        assert ("left out" in caption) == name.startswith(("blank", "turned"))
        assert ("no tag found" in caption) == name.startswith("blank")
        assert (TURNED in caption) == name.startswith("turned")
    error = capture.photos[0].reprojection_px
    assert captions["object0.png"] == f"1: object0.png, {error:.2f} px"


def ink(image, colour):
    """Where a grey picture was drawn on in a colour, smoothed edges and all: ORANGE is redder than grey, SKY bluer."""
    red, _, blue = rgb(colour)
    redder = image[..., 0].astype(int) - image[..., 2]
    return redder * np.sign(red - blue) > 20


@pytest.mark.parametrize("scale", [0.5, 1, 3])
def test_outlines_and_crosses_lie_where_the_corners_are(scale):
    square = np.array([[100.0, 60.0], [180.0, 60.0], [180.0, 140.0], [100.0, 140.0]])
    off = np.array([30.0, 20.0])
    outcome = Outcome(
        1, NOWHERE, {7: Mark(SQUARE * 0.06, square)}, {7: np.tile(off, (4, 1))}, float(np.linalg.norm(off)), ""
    )
    grey = np.full((240, 320, 3), 128, np.uint8)
    small = annotated(grey, outcome, round(320 * scale), 10_000)
    assert small.shape == (round(240 * scale), round(320 * scale), 3)
    assert (grey == 128).all()  # drawn on a copy
    middle = np.s_[round(75 * scale) : round(125 * scale), round(110 * scale) : round(170 * scale)]
    outline, crosses = ink(small, ORANGE), ink(small, SKY)
    assert outline[middle].any()  # the id
    outline[middle] = False
    rows, cols = (np.nonzero(outline)[i] for i in (0, 1))
    # Pixel centres are at +0.5, and lines are two pixels wide.
    box = (np.array([cols.min(), rows.min(), cols.max(), rows.max()]) + 0.5) / scale
    np.testing.assert_allclose(box, [100, 60, 180, 140], atol=2.6 / scale)
    for corner in square + off:
        col, row = np.floor(corner * scale).astype(int)
        assert (small[row - 2 : row + 2, col - 2 : col + 2] != 128).any()
    rows, cols = np.nonzero(crosses)
    box = np.array([cols.min(), rows.min(), cols.max(), rows.max()]) + 0.5
    np.testing.assert_allclose(box, [130 * scale - 5, 80 * scale - 5, 210 * scale + 5, 160 * scale + 5], atol=2)


def test_photos_held_either_way_fit_the_box():
    outcome = Outcome(1, NOWHERE, {}, {}, None, "no tag found")
    assert annotated(np.zeros((400, 300, 3), np.uint8), outcome, 200, 150).shape == (150, 112, 3)
    assert annotated(np.zeros((300, 400, 3), np.uint8), outcome, 200, 150).shape == (150, 200, 3)


def numbered(count, left_out=()):
    return [Outcome(n, NOWHERE, {}, {}, 0.1, "blurred" if n in left_out else "") for n in range(1, count + 1)]


def test_many_photos_are_thinned_out_evenly_but_those_left_out_stay():
    assert thinned(numbered(MOST), MOST) == numbered(MOST)
    many = numbered(200, left_out=(17, 18, 120))
    shown = thinned(many, MOST)
    numbers = [o.number for o in shown]
    assert len(numbers) == len(set(numbers)) == MOST and numbers == sorted(numbers)
    assert {1, 17, 18, 120, 200} <= set(numbers)
    assert max(np.diff([n for n in numbers if n not in (17, 18, 120)])) <= 12
    hopeless = [o.number for o in thinned(numbered(200, left_out=range(1, 151)), MOST)]
    assert len(hopeless) == MOST and sum(n <= 150 for n in hopeless) == MOST // 2
    text = heading("photos", many, shown)
    assert "200 photos" in text and "3 left out" in text and f"{MOST} evenly chosen" in text
    assert "chosen" not in heading("photos", many, many)


def test_a_large_capture_makes_a_sheet_of_readable_size(tmp_path):
    path = stub(tmp_path / "x.png", 32, 24)
    one = Outcome(1, path, {}, {}, 0.1, "")
    pages = [tag_sheet({"photos": [one] * count}, 4 / 3) for count in (MOST, 500)]
    assert abs(pages[0].shape[0] - pages[1].shape[0]) < 50


def test_names_that_would_trip_the_font_are_drawn(tmp_path):
    assert readable("Grüße $1$ \u5bb6\n.png") == "Grüße $1$ ??.png"
    assert shortened("abcdefghij", 10) == "abcdefghij"
    assert shortened("abcdefghijk", 10) == "abcd…ghijk"
    path = stub(tmp_path / "a$^{_\u5bb6$.png", 32, 24)
    outcomes = [Outcome(n, path, {}, {}, None, "no $tag_ found") for n in (1, 2)]
    for picture in (tag_sheet({"photos": outcomes}, 4 / 3), pixels_of(error_chart({"photos": outcomes}, LENS))):
        assert picture.std() > 1


def test_magnification_takes_round_steps():
    assert [magnification(1.0, target) for target in (0.5, 1.0, 2.0, 4.9, 5.0, 99.0, 100.0)] == [1, 1, 2, 2, 5, 50, 100]
    assert magnification(0.3, 0.06 * 4000) == 500
    assert magnification(0.0, 10.0) == 1


def test_mean_residuals_show_what_noise_hides():
    rng = np.random.default_rng(0)
    seen = rng.random((4000, 2)) * [320, 240]
    outward = 0.002 * (seen - [160, 120])
    places, means = cell_means(seen, outward + 0.3 * rng.standard_normal(seen.shape), 320, 240)
    assert len(places) == 108
    assert np.abs(means - 0.002 * (places - [160, 120])).max() < 0.25
    assert cell_means(seen[:0], seen[:0], 320, 240)[0].shape == (0, 2)


def test_photos_left_out_do_not_count_among_the_residuals(capture):
    outcomes = calibration_outcomes(capture)
    seen, rest = corners_and_residuals(outcomes)
    assert len(seen) == len(rest) == sum(4 * len(o.marks) for o in outcomes)
    assert np.sqrt((rest**2).sum(1).mean()) == pytest.approx(capture.calibration.rms)
    assert corners_and_residuals([o for o in outcomes if o.reason])[0].shape == (0, 2)


def test_displacement_is_the_lens_polynomial():
    lens = Lens(200, 100, 100.0, 100.0, 100.0, 50.0, (-0.1, 0.0, 0.0, 0.0, 0.0))
    # At a tangent of 1, k1 pulls in by a tenth: 10 pixels at a focal length of 100.
    np.testing.assert_allclose(
        displacement(lens, np.array([[200.0, 50.0], [100.0, 50.0]])), [[-10, 0], [0, 0]], atol=1e-9
    )


def test_parameters_say_what_was_free(capture):
    text = parameters(capture.calibration)
    assert f"focal {capture.calibration.lens.fx:.0f}"[:8] in text and "±" in text
    for name in capture.calibration.deviations:
        assert name in text.split("kept")[0]


def test_map_draws_tags_and_frusta_where_they_are(capture):
    tags = tag_corners(capture)
    assert set(tags) == set(capture.solved.tags)
    for corners in tags.values():
        assert np.linalg.norm(corners[0] - corners[1]) == pytest.approx(SHEET.size)
    points = frustum(np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]]), 100, 80, 2.0)
    np.testing.assert_allclose(points, [[0, 0, 0], [-1, -0.8, 2], [1, -0.8, 2], [1, 0.8, 2], [-1, 0.8, 2]])
    with pytest.raises(TypeCheckError):
        frustum(np.eye(4), 100, 80, 2.0)
