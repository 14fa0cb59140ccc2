import json
import shutil
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
import yaml
from PIL import Image

from benchmarks.capture_accuracy import solve_home_frame
from benchmarks.synthetic.photos import Flaws, Truth, render_photo
from benchmarks.synthetic.tabletop import Tabletop
from nerf_lightning.cameras import transform_points
from nerf_lightning.capture.pipeline import Capture, capture_scene
from nerf_lightning.capture.poses.calibrate import calibrate
from nerf_lightning.capture.poses.geometry import angle_between, invert_pose, project_points
from nerf_lightning.capture.tags.detect import detect_tags, guess_dictionary, make_tag_detector
from nerf_lightning.capture.tags.tag_layout import read_layout
from nerf_lightning.cli.capture import capture
from nerf_lightning.dataset import open_scene
from nerf_lightning.dataset.sfm.photo_folder import find_photos
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import encode_exif
from tests.helpers.tag_views import SIX_TAGS, SMALL_LENS, TAG_SIZE


def test_capture_scene_synthetic_photos_finds_cameras(tag_capture: tuple[Path, Truth], packed: tuple[Path, Capture]):
    (_, truth), (folder, found) = tag_capture, packed
    entries = json.loads((folder / "cameras.json").read_text())["photos"]
    assert [entry["name"] for entry in entries] == sorted(truth.photos)
    assert all(set(entry) == {"name", "status", "reason", "K", "c2w", "reprojection_px"} for entry in entries)
    placed = [entry for entry in entries if entry["status"] == "placed"]
    assert len(placed) >= 7
    shifts, angles = [], []
    for entry in placed:
        exact, solved = truth.photos[entry["name"]], solve_home_frame(found.solution, SIX_TAGS) @ np.array(entry["c2w"])
        shifts.append(np.linalg.norm(solved[:3, 3] - exact[:3, 3]) / np.linalg.norm(exact[:3, 3]))
        angles.append(angle_between(solved, exact))
    assert np.median(shifts) < 0.02 and np.median(angles) < np.radians(0.6)
    assert abs(found.calibration.lens.fx / SMALL_LENS.fx - 1) < 0.02
    assert sorted(file.name for file in folder.iterdir()) == ["calibration.yaml", "cameras.json", "scene.npz"]
    content = yaml.safe_load((folder / "calibration.yaml").read_text())
    assert content["fx"] == pytest.approx(found.calibration.lens.fx) and content["standard_deviations"]["focal"] > 0
    assert content["photos_used"] and set(content["tags"]["to_world"]) <= set(range(6))


def test_capture_scene_writes_scene_with_subject_in_box(packed: tuple[Path, Capture]):
    folder, found = packed
    scene = open_scene(str(folder / "scene.npz"))
    assert scene.resolution == (200, 150) and scene.bounds.unbounded
    assert len(scene.train) + len(scene.val) == sum(photo.c2w is not None for photo in found.photos)
    assert len(scene.val) == 2
    assert torch.equal(scene.train.images, found.scene.train.images)
    corners = torch.from_numpy(Tabletop(SIX_TAGS).box).float()
    from_truth = torch.from_numpy(invert_pose(solve_home_frame(found.solution, SIX_TAGS))).float()
    subject = transform_points(from_truth, torch.cartesian_prod(*corners.T))
    low, high = scene.bounds.aabb
    assert (low < subject.amin(0)).all() and (subject.amax(0) < high).all()
    assert (high - low).max() < 4 * (corners[1] - corners[0]).max()
    distances = (scene.train.cameras.centers - scene.bounds.center).norm(dim=1)
    assert 0 < scene.bounds.near < float(distances.min())
    assert (scene.orbit.centers[:, 2] > 0).all()  # above the paper, at the cameras' distance
    of_orbit = (scene.orbit.centers - scene.bounds.center).norm(dim=1)
    assert 0.8 * distances.min() < of_orbit.min() and of_orbit.max() < 1.2 * distances.max()


def test_detect_tags_corners_have_no_offset(tag_capture: tuple[Path, Truth]):
    """Pixel centers at +0.5: the mean of all corner errors vanishes."""
    folder, truth = tag_capture
    found = detect_tags(find_photos(folder / "calibration", "calibration"), make_tag_detector("DICT_4X4_50", TAG_SIZE))
    errors = [
        mark.pixels - project_points(SMALL_LENS, invert_pose(truth.calibration[s.name]), SIX_TAGS.corners(tag))
        for s in found
        for tag, mark in s.detections.items()
    ]
    flat = np.concatenate(errors)
    assert len(flat) > 100 and np.abs(np.median(flat, axis=0)).max() < 0.05 and np.abs(flat).max() < 2


def test_detect_tags_in_rotated_photos_turns_them_upright(tag_capture: tuple[Path, Truth], tmp_path: Path):
    original = tag_capture[0] / "calibration" / "000.png"
    # EXIF orientation 6: to be turned clockwise by 90 degrees.
    tilted = Image.fromarray(np.ascontiguousarray(np.rot90(imageio.imread(original))))
    tilted.save(tmp_path / "phone.jpg", quality=98, exif=encode_exif(6))
    plain, turned = detect_tags([original, tmp_path / "phone.jpg"], make_tag_detector("DICT_4X4_50", TAG_SIZE))
    assert len(plain.detections) == 6 and sorted(turned.detections) == sorted(plain.detections)
    assert (turned.width, turned.height) == (SMALL_LENS.width, SMALL_LENS.height)
    for tag, mark in turned.detections.items():
        np.testing.assert_allclose(mark.pixels, plain.detections[tag].pixels, atol=0.1)


def test_guess_dictionary_finds_the_printed_one(tag_capture: tuple[Path, Truth], tmp_path: Path):
    assert guess_dictionary(find_photos(tag_capture[0] / "calibration", "calibration")) == "DICT_4X4_50"
    imageio.imwrite(tmp_path / "gray.png", np.full((100, 120, 3), 128, np.uint8))
    with pytest.raises(InputError, match="no tag"):
        guess_dictionary([tmp_path / "gray.png"])


@pytest.fixture(scope="module")
def few_photos(tag_capture: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Three photos of each kind, which takes little time."""
    folder = tmp_path_factory.mktemp("few")
    for kind in ("calibration", "photos"):
        (folder / kind).mkdir()
        for i in range(3):
            (folder / kind / f"{i}.png").symlink_to(tag_capture[0] / kind / f"{2 * i:03d}.png")
    return {"calibration": folder / "calibration", "photos": folder / "photos"}


def test_capture_writes_scene_and_report(few_photos: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture):
    output = tmp_path / "it's mine, ü" / "scene.npz"
    found = capture(**few_photos, tag_size=TAG_SIZE, output=output, resize=120)
    assert open_scene(str(output)).resolution == (120, 90) and len(found.photos) == 3
    assert len(list((output.parent / "scene_report").glob("*.png"))) == 3
    assert "3 of 3 photos placed" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"tag_size": 6.0}, "tag_size.*at most 1"),
        ({"dictionary": "DICT_9X9"}, "dictionary"),
        ({"output": Path("scene.txt")}, ".npz"),
        ({"calibration": Path("nowhere")}, "nowhere"),
        ({"board_columns": 5, "board_rows": 7}, "board_square"),
    ],
)
def test_capture_with_bad_option_names_it(few_photos: dict[str, Path], tmp_path: Path, changes: dict, words: str):
    given = few_photos | {"tag_size": TAG_SIZE, "dictionary": "DICT_4X4_50", "output": tmp_path / "scene.npz"}
    with pytest.raises(InputError, match=words):
        capture(**given | changes)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("photo", "words"), [((300, 400), "no tag"), ((400, 300), "a.png.*rotated by 90 degrees"), (None, "a.png")]
)
def test_capture_with_bad_photo_names_it(few_photos: dict[str, Path], tmp_path: Path, photo: tuple | None, words: str):
    file = tmp_path / "a.png"
    if photo is None:
        file.write_bytes(b"nothing")
    else:
        imageio.imwrite(file, np.full((*photo, 3), 90, np.uint8))
    with pytest.raises(InputError, match=words):
        capture_scene(few_photos["calibration"], tmp_path, TAG_SIZE, tmp_path / "scene.npz", dictionary="DICT_4X4_50")
    assert list(tmp_path.iterdir()) == [file]


def test_read_layout_gives_corners_in_meters_or_names_file(tmp_path: Path):
    file = tmp_path / "sheet.yaml"
    file.write_text("tags: {0: {x: 0.0, y: 0.0}, 3: {x: 0.09, y: -0.02, turn: 90}}")
    layout = read_layout(file, "DICT_4X4_50", TAG_SIZE)
    around = np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    np.testing.assert_allclose(layout.corners(0), TAG_SIZE / 2 * around)
    np.testing.assert_allclose(layout.corners(3)[0], [0.09 - TAG_SIZE / 2, -0.02 - TAG_SIZE / 2, 0], atol=1e-12)
    for text in ("[1]", "{0: {x: 0}}", "{0: {x: 0, y: 0, z: 1}}", "{0: {x: .inf, y: 0}}", "["):
        file.write_text(f"tags: {text}")
        with pytest.raises(InputError, match=r"sheet\.yaml"):
            read_layout(file, "DICT_4X4_50", TAG_SIZE)


def test_capture_scene_with_hidden_tags_registers_photos_by_texture(tag_capture: tuple[Path, Truth], tmp_path: Path):
    shown, truth = tag_capture
    shutil.copytree(shown, tmp_path, dirs_exist_ok=True)
    hidden = ["003.png", "005.png"]
    for name in hidden:
        photo = render_photo(SIX_TAGS, SMALL_LENS, truth.photos[name], True, Flaws(), seed=0, samples=2, hidden=True)
        imageio.imwrite(tmp_path / "photos" / name, photo)
    given = tmp_path / "calibration", tmp_path / "photos", TAG_SIZE, tmp_path / "scene.npz"
    found = capture_scene(*given, dictionary="DICT_4X4_50", max_side=100)
    assert [photo.name for photo in found.photos if photo.method == "texture"] == hidden
    for photo in found.photos:
        if photo.method:
            solved, exact = solve_home_frame(found.solution, SIX_TAGS) @ photo.c2w, truth.photos[photo.name]
            assert np.linalg.norm(solved[:3, 3] - exact[:3, 3]) < 0.02 * np.linalg.norm(exact[:3, 3])
            assert angle_between(solved, exact) < np.radians(1)
            assert 0 < photo.reprojection_px < 2
    entries = {entry["name"]: entry for entry in json.loads((tmp_path / "cameras.json").read_text())["photos"]}
    assert [name for name, entry in entries.items() if entry.get("by") == "texture"] == hidden


@pytest.mark.real_data
def test_capture_scene_of_real_photos_registers_all(real_data: Path, tmp_path: Path):
    """Six tags on a curled page, then an object next to one of them."""
    folder = real_data / "aruco_capture"
    found = capture_scene(folder / "calibration", folder / "object", 0.055, tmp_path / "scene.npz")
    assert found.calibration.rms < 2 and not found.calibration.excluded
    assert all(photo.c2w is not None and photo.reprojection_px < 2 for photo in found.photos)
    sheet = detect_tags(find_photos(folder / "calibration", ""), make_tag_detector("DICT_4X4_50", 0.055))
    again = calibrate(folder, [replace(s, detections=dict(reversed(s.detections.items()))) for s in sheet], None)
    assert again.lens.fx == pytest.approx(found.calibration.lens.fx, rel=1e-3)  # the order of tags does not matter
