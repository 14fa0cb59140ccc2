import json
from dataclasses import replace
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import yaml
from capture.views import LENS, SIX, SIZE, SMALL
from PIL import Image

from benchmarks.capture import home
from benchmarks.synthetic.photos import Truth
from benchmarks.synthetic.tabletop import Tabletop
from nerf_lightning.cameras import transform
from nerf_lightning.capture.outputs import Packing
from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import angle_between, inverse, project
from nerf_lightning.capture.run import Capture, capture
from nerf_lightning.capture.tags.detect import guess_family, sight, tag_detector
from nerf_lightning.capture.tags.layout import TagLayout, flat_pose, read_layout
from nerf_lightning.dataset import open_scene
from nerf_lightning.dataset.lens import rectify
from nerf_lightning.dataset.placing.photos import find_photos
from nerf_lightning.errors import InputError


def test_a_synthetic_capture_gives_back_its_cameras(made: tuple[Path, Truth], packed: tuple[Path, Capture]):
    (_, truth), (folder, found) = made, packed
    entries = json.loads((folder / "cameras.json").read_text())["photos"]
    assert [entry["name"] for entry in entries] == sorted(truth.photos)
    assert all(set(entry) == {"name", "status", "reason", "K", "c2w", "reprojection_px"} for entry in entries)
    placed = [entry for entry in entries if entry["status"] == "placed"]
    assert len(placed) >= 7
    off, turned = [], []
    for entry in placed:
        pose, told = truth.photos[entry["name"]], home(found.solved, SIX) @ np.array(entry["c2w"])
        off.append(np.linalg.norm(told[:3, 3] - pose[:3, 3]) / np.linalg.norm(pose[:3, 3]))
        turned.append(angle_between(told, pose))
    assert np.median(off) < 0.02 and np.median(turned) < np.radians(0.6)
    assert abs(found.calibration.lens.fx / SMALL.fx - 1) < 0.02


def test_the_scene_trains_like_any_other(packed: tuple[Path, Capture]):
    folder, found = packed
    scene = open_scene(str(folder / "scene.npz"))
    assert scene.resolution == (200, 150) and scene.bounds.unbounded
    assert len(scene.train) + len(scene.val) == len([p for p in found.photos if p.status == "placed"])
    assert len(scene.val) == 2
    assert torch.equal(scene.train.images, found.scene.train.images)
    # The subject stands in the box, which is no more than four times as wide; the orbit looks at it from the cameras' height.
    corners = torch.from_numpy(Tabletop(SIX).box).float()
    from_truth = torch.from_numpy(inverse(home(found.solved, SIX))).float()
    subject = transform(from_truth, torch.cartesian_prod(*corners.T))
    low, high = scene.bounds.aabb
    assert (low < subject.amin(0)).all() and (subject.amax(0) < high).all()
    assert (high - low).max() < 4 * (corners[1] - corners[0]).max()
    heights = scene.orbit.centres[:, 2]
    assert heights.std() < 1e-4 and heights.min() > 0
    assert 0 < scene.bounds.near < float((scene.train.cameras.centres - scene.bounds.centre).norm(dim=1).min())


def test_calibration_is_written_for_people_and_programs(packed: tuple[Path, Capture]):
    folder, found = packed
    assert sorted(file.name for file in folder.iterdir()) == ["calibration.yaml", "cameras.json", "scene.npz"]
    content = yaml.safe_load((folder / "calibration.yaml").read_text())
    assert content["fx"] == pytest.approx(found.calibration.lens.fx)
    assert content["tags"]["dictionary"] == "DICT_4X4_50"
    assert len(content["tags"]["to_world"]) >= 3 and set(content["tags"]["to_world"]) <= set(range(6))
    assert content["photos_used"] and content["standard_deviations"]["focal"] > 0


def test_undistorted_points_lie_where_a_pinhole_camera_puts_them():
    """A grid of world points through the lens, mapped as `rectify` maps pixels, against the K that is written."""
    rectification = rectify(LENS)
    rng = np.random.default_rng(0)
    points = np.c_[rng.uniform(-0.4, 0.4, (400, 2)), np.ones(400)]
    ideal = points @ rectification.K.T
    inside = (ideal[:, :2] > 2).all(1) & (ideal[:, 0] < LENS.width - 3) & (ideal[:, 1] < LENS.height - 3)
    maps = np.stack([rectification.col, rectification.row])
    col, row = (np.ascontiguousarray(k[:, None], np.float32) for k in (ideal[inside, :2] - 0.5).T)
    back = np.stack([cv2.remap(m, col, row, cv2.INTER_LINEAR)[:, 0] for m in maps], axis=1) + 0.5
    seen = project(LENS, np.eye(4), points[inside])
    assert inside.sum() > 200 and np.abs(back - seen).max() < 0.05


def test_no_pixel_of_the_scene_lacks_a_source(packed: tuple[Path, Capture]):
    """White photos stay white to the last pixel: undistortion brings no black border."""
    rectification = rectify(packed[1].calibration.lens)
    white = np.full((SMALL.height, SMALL.width, 3), 255, np.uint8)
    assert rectification.apply(white).min() == 255
    assert rectification.col.min() > -0.5 and rectification.col.max() < SMALL.width - 0.5
    assert rectification.row.min() > -0.5 and rectification.row.max() < SMALL.height - 0.5


def test_corners_carry_no_offset(made: tuple[Path, Truth]):
    """Pixel centres at +0.5: the mean of all corner errors vanishes."""
    folder, truth = made
    errors = [
        mark.pixels - project(SMALL, inverse(truth.calibration[s.name]), SIX.corners(tag))
        for s in sight(find_photos(folder / "calibration", "calibration"), tag_detector("DICT_4X4_50", SIZE))
        for tag, mark in s.marks.items()
    ]
    flat = np.concatenate(errors)
    assert len(flat) > 100 and np.abs(np.median(flat, axis=0)).max() < 0.05 and np.abs(flat).max() < 2


def test_families_are_told_from_the_photos(made: tuple[Path, Truth], tmp_path: Path):
    assert guess_family(find_photos(made[0] / "calibration", "calibration")) == "DICT_4X4_50"
    imageio.imwrite(tmp_path / "grey.png", np.full((100, 120, 3), 128, np.uint8))
    with pytest.raises(InputError, match="no tag of a common family in 1 of 1 photos"):
        guess_family([tmp_path / "grey.png"])
    with pytest.raises(InputError, match=r"tags.dictionary: found DICT_9X9"):
        tag_detector("DICT_9X9", SIZE)


@pytest.fixture(scope="module")
def few(made: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three photos of each kind, which takes little time."""
    folder = tmp_path_factory.mktemp("few")
    for kind in ("calibration", "photos"):
        (folder / kind).mkdir()
        for i in range(3):
            (folder / kind / f"{i}.png").symlink_to(made[0] / kind / f"{2 * i:03d}.png")
    return folder


def run(folder: Path, tmp_path: Path, **changes):
    packing = Packing(changes.pop("output", tmp_path / "scene.npz"), orbit=changes.pop("orbit", None))
    options = {"calibration": folder / "calibration", "photos": folder / "photos", "size": SIZE}
    return capture(**options | {"packing": packing, "dictionary": "DICT_4X4_50"} | changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"size": 60.0}, "tags.size: found 60, expected the side .* in metres"),
        ({"size": 6.0}, "m away from the tags, expected 0.03 to 30 m; give the side"),
        ({"dictionary": "DICT_7X7_50"}, "no tag of DICT_7X7_50 in 3 photos"),
        ({"output": Path("scene.txt")}, "ends in .npz"),
        ({"orbit": "999.png"}, "orbit: found 999.png, expected a photo's name, such as "),
        ({"calibration": Path("nowhere")}, "calibration: found nowhere, which is no folder"),
    ],
)
def test_bad_input_says_what_to_do(few: Path, tmp_path: Path, changes: dict, words: str):
    with pytest.raises(InputError, match=words):
        run(few, tmp_path, **changes)
    assert not list(tmp_path.glob("**/*.npz")) and not list(tmp_path.glob("*.json"))


def test_an_orbit_through_a_photo_left_out_is_refused(made: tuple[Path, Truth]):
    paths = find_photos(made[0] / "photos", "photos")
    c2w = np.stack([made[1].photos[path.name] for path in paths])
    with pytest.raises(InputError, match=f"orbit: found {paths[0].name}, expected a placed photo"):
        pack(paths[1:], c2w[1:], SMALL, "small", "tests", orbit=paths[0].name)


def test_folders_of_the_wrong_kind(few: Path, tmp_path: Path):
    (tmp_path / "raw").mkdir()
    (tmp_path / "raw" / "a.DNG").write_bytes(b"x")
    with pytest.raises(
        InputError, match="only .dng files, expected JPEG, PNG, TIFF or HEIC photos; convert them first"
    ):
        run(few, tmp_path, photos=tmp_path / "raw")
    plain = tmp_path / "plain"
    plain.mkdir()
    imageio.imwrite(plain / "a.png", np.full((300, 400, 3), 90, np.uint8))
    with pytest.raises(InputError, match="no tag of DICT_4X4_50 in 1 photos.*folders swapped"):
        run(few, tmp_path, photos=plain)
    imageio.imwrite(plain / "a.png", np.full((400, 300, 3), 90, np.uint8))
    with pytest.raises(InputError, match="a.png: found 300x400 pixels, held the other way"):
        run(few, tmp_path, photos=plain)
    (plain / "a.png").write_bytes(b"nothing")
    with pytest.raises(InputError, match="a.png"):
        run(few, tmp_path, photos=plain)


def test_photos_in_natural_order(tmp_path: Path):
    for name in ("IMG_10.jpg", "IMG_9.JPG", "img_2.png", ".hidden.png", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    assert [p.name for p in find_photos(tmp_path, "photos")] == ["img_2.png", "IMG_9.JPG", "IMG_10.jpg"]


def test_a_known_sheet(tmp_path: Path):
    file = tmp_path / "sheet.yaml"
    file.write_text("tags: {0: {x: 0.0, y: 0.0}, 3: {x: 0.09, y: -0.02, turn: 90}}")
    layout = read_layout(file, "DICT_4X4_50", SIZE)
    np.testing.assert_allclose(layout.corners(0), SIZE / 2 * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]]))
    np.testing.assert_allclose(layout.corners(3)[0], [0.09 - SIZE / 2, -0.02 - SIZE / 2, 0], atol=1e-12)
    assert isinstance(layout, TagLayout) and np.array_equal(flat_pose(0, 0), np.eye(4))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tags: [1, 2]", "tags: found"),
        ("tags: {a: {x: 0, y: 0}}", "tags.a: found 'a', expected a whole number"),
        ("tags: {0: {x: 0}}", "tags.0: found"),
        ("tags: {0: {x: 0, y: yes}}", "tags.0: found"),
        ("tags: {0: {x: 0, y: 0, z: 1}}", "tags.0: found"),
        ("tags: {0: {x: 0, y: .inf}}", "tags.0: found"),
        ("tags: {0: {x: 0, y: 1.0e+39}}", "tags.0: found"),
        ("tags: {0: {x: 0, y: 1" + 400 * "0" + "}}", "sheet.yaml: found no YAML"),
        (f"tags: {{{2**64}: {{x: 0, y: 0}}}}", f"tags.{2**64}: found {2**64}, expected a whole number below 2320"),
        ("tags: [", "sheet.yaml: found no YAML"),
    ],
)
def test_a_malformed_sheet_is_refused(tmp_path: Path, text: str, words: str):
    file = tmp_path / "sheet.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=words):
        read_layout(file, "DICT_4X4_50", SIZE)
    with pytest.raises(InputError, match="none.yaml: found nothing there"):
        read_layout(tmp_path / "none.yaml", "DICT_4X4_50", SIZE)


@pytest.mark.real_data
def test_a_real_capture(real_data: Path, tmp_path: Path):
    """Six tags on a curled page, then an object beside one of them."""
    folder = real_data / "aruco_capture"
    found = capture(folder / "calibration", folder / "object", 0.055, Packing(tmp_path / "scene.npz"))
    assert found.calibration.rms < 2 and not found.calibration.dropped
    assert [photo.status for photo in found.photos] == ["placed"] * 5
    assert max(photo.reprojection_px for photo in found.photos) < 2
    sheet = sight(find_photos(folder / "calibration", ""), tag_detector("DICT_4X4_50", 0.055))
    again = calibrate(folder, [replace(s, marks=dict(reversed(s.marks.items()))) for s in sheet], None)
    assert again.lens.fx == pytest.approx(found.calibration.lens.fx, rel=1e-3)  # the order of tags does not matter


def test_photos_of_all_kinds_are_read_and_turned_upright(made: tuple[Path, Truth], tmp_path: Path):
    original = made[0] / "calibration" / "000.png"
    photo = imageio.imread(original)
    paths = [original, *(tmp_path / f"a{suffix}" for suffix in (".png", ".jpg", ".tiff"))]
    for path in paths[1:]:
        cv2.imwrite(str(path), photo[..., ::-1])
    # EXIF orientation 6: to be turned clockwise by 90 degrees.
    tilted = Image.fromarray(np.ascontiguousarray(np.rot90(photo)))
    exif = Image.Exif()
    exif[0x0112] = 6
    tilted.save(tmp_path / "phone.jpg", quality=98, exif=exif)
    plain, *others = sight([*paths, tmp_path / "phone.jpg"], tag_detector("DICT_4X4_50", SIZE))
    assert len(plain.marks) == 6
    for seen in others:
        assert (seen.width, seen.height) == (SMALL.width, SMALL.height) and sorted(seen.marks) == sorted(plain.marks)
        for tag, mark in seen.marks.items():
            np.testing.assert_allclose(mark.pixels, plain.marks[tag].pixels, atol=0.1)
