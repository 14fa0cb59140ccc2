import logging
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from benchmarks.synthetic.photos import Truth
from benchmarks.video import align_poses
from nerf_lightning.capture.poses.geometry import invert_pose
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.dataset.sfm import colmap
from nerf_lightning.dataset.sfm import photo_folder as module
from nerf_lightning.dataset.sfm.photo_folder import find_photos, run_sfm
from nerf_lightning.errors import InputError
from tests.helpers.exif_tags import encode_exif

SMALLER = ("3.jpg", "4.jpg")
"""Taken by a second camera."""
TURNED = ("5.jpg", "6.jpg")
"""Stored sideways, with an EXIF orientation."""


@pytest.fixture(scope="module")
def photos(tag_capture: tuple[Path, Truth], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A third of an orbit: two cameras, and two photos with an EXIF rotation; read only."""
    folder = tmp_path_factory.mktemp("photos")
    for number, path in enumerate(sorted((tag_capture[0] / "photos").iterdir())):
        pixels = read_pixels(path)
        name = f"{number}.jpg"
        if name in SMALLER:
            pixels = cv2.resize(pixels, (380, 285), interpolation=cv2.INTER_AREA)
        stored = np.rot90(pixels) if name in TURNED else pixels
        # 350 pixels of 400x300 are 30 mm on film; the smaller photos have no focal length.
        exif = encode_exif(6 if name in TURNED else 1, focal_35mm=0 if name in SMALLER else 30)
        Image.fromarray(np.ascontiguousarray(stored)).save(folder / name, quality=97, exif=exif)
    return folder


@pytest.fixture(scope="module")
def reconstruction(photos: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[pycolmap.Reconstruction, Path]:
    """COLMAP's model from copies smaller than the photos, and its workspace."""
    workspace = tmp_path_factory.mktemp("workspace")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(colmap, "COPY_SIDE_PX", 390)
        model = colmap.reconstruct(find_photos(photos, ""), workspace)
    assert model is not None
    return model, workspace


@pytest.fixture
def sfm_folder(photos: Path, reconstruction, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, list[int]]:
    """A copy of the photos with a cached reconstruction; and the number of photos in each call."""
    folder, calls = tmp_path / "photos", []
    shutil.copytree(photos, folder)
    monkeypatch.setenv("NERF_LIGHTNING_CACHE", str(tmp_path / "cache"))

    def reconstruct(photos: list[Path], workspace: Path) -> pycolmap.Reconstruction:
        calls.append(len(photos))
        return reconstruction[0]

    monkeypatch.setattr(module, "reconstruct", reconstruct)
    return folder, calls


def test_reconstruct_two_cameras_gives_upright_model(reconstruction, tag_capture: tuple[Path, Truth], tmp_path: Path):
    reconstruction[0].write_binary(tmp_path)
    model = pycolmap.Reconstruction(tmp_path)
    images = {image.name: image for image in model.images.values() if image.has_pose}
    assert len(images) >= 7 and set(images) <= {f"{number}.jpg" for number in range(8)}
    sizes = {
        name: (model.cameras[image.camera_id].width, model.cameras[image.camera_id].height)
        for name, image in images.items()
    }
    assert sizes == {name: (380, 285) if name in SMALLER else (400, 300) for name in images}
    kinds = {image.camera_id: model.cameras[image.camera_id].model_name for image in images.values()}
    assert sorted(kinds.values()) == ["OPENCV", "SIMPLE_RADIAL"]
    for image in images.values():
        camera = model.cameras[image.camera_id]
        assert camera.mean_focal_length() == pytest.approx(350 * camera.width / 400, rel=0.15)
    error = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    assert error == pytest.approx(model.compute_mean_reprojection_error()) and 0.05 < error < 1.5
    last = [[0.0, 0.0, 0.0, 1.0]]
    found = np.stack([invert_pose(np.concatenate([i.cam_from_world().matrix(), last])) for i in images.values()])
    truth = np.stack([tag_capture[1].photos[f"{int(Path(name).stem):03d}.png"] for name in images])
    off = np.linalg.norm(align_poses(found, truth)[:, :3, 3] - truth[:, :3, 3], axis=-1)
    assert np.median(off / np.linalg.norm(truth[:, :3, 3], axis=-1)) < 0.05


def test_reconstruct_exif_focal_is_the_prior(reconstruction):
    with pycolmap.Database.open(reconstruction[1] / "database.db") as content:
        cameras = {camera.width: camera for camera in content.read_all_cameras()}
        counts = [image.camera_id for image in content.read_all_images()]
    assert sorted(cameras) == [380, 390] and sorted(map(counts.count, set(counts))) == [2, 6]
    assert cameras[390].has_prior_focal_length and not cameras[380].has_prior_focal_length
    assert cameras[390].mean_focal_length() == pytest.approx(30 / np.hypot(36, 24) * 500 * 390 / 400, rel=1e-3)
    assert cameras[380].mean_focal_length() == pytest.approx(1.2 * 380)


@pytest.mark.parametrize(
    ("exif", "pixels"),
    [
        ({}, None),
        ({"focal_35mm": 26}, 26 / np.hypot(36, 24) * np.hypot(600, 400)),
        ({"focal": 50.0, "make": "Canon", "model": "Canon EOS 5D Mark II"}, 600 * 50 / 36),  # a sensor as wide as film
        ({"focal": IFDRational(50, 0), "make": " A\0  B "}, None),
    ],
)
def test_read_lens_tags_let_colmap_infer_focal(exif: dict, pixels: float | None, tmp_path: Path):
    photo, copy = tmp_path / "a.jpg", tmp_path / "copy.jpg"
    Image.new("RGB", (60, 40)).save(photo, exif=encode_exif(6, **exif))
    Image.new("RGB", (600, 400)).save(copy, exif=colmap.read_lens_tags(photo))
    with Image.open(copy) as image:
        assert 0x0112 not in image.getexif()  # upright already
    camera = pycolmap.infer_camera_from_image(copy)
    assert camera.has_prior_focal_length == (pixels is not None)
    assert pixels is None or camera.mean_focal_length() == pytest.approx(pixels, rel=1e-3)


def test_run_sfm_twice_reconstructs_once(sfm_folder, caplog: pytest.LogCaptureFixture):
    folder, calls = sfm_folder
    caplog.set_level(logging.INFO)
    assert run_sfm(folder) == run_sfm(folder) and calls == [8]
    assert "reused from an earlier run" in caplog.text and "of 8 photos registered" in caplog.text
    assert pycolmap.Reconstruction(run_sfm(folder)).num_reg_images() >= 7
    shutil.copy(folder / "7.jpg", folder / "8.jpg")
    run_sfm(folder)
    assert "the source files changed" in caplog.text and "not registered" in caplog.text and "8.jpg" in caplog.text
    (folder / "8.jpg").touch()
    run_sfm(folder)
    assert calls == [8, 9, 9]


def test_run_sfm_disconnected_photos_raise(sfm_folder, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "reconstruct", lambda photos, workspace: None)
    with pytest.raises(InputError, match="0 of 8 photos that COLMAP could register, expected at least 3; take more"):
        run_sfm(sfm_folder[0])
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    with pytest.raises(InputError, match=r"pip install 'nerf_lightning\[colmap\]'"):
        run_sfm(sfm_folder[0])


def test_pair_photos_many_gives_window_and_loop_pairs():
    assert len(colmap.pair_photos(150)) == 150 * 149 // 2
    some = colmap.pair_photos(1000)
    assert len(some) == len(set(some)) < 25_000 and all(0 <= i < j < 1000 for i, j in some)
    assert {(i, i + 20) for i in range(980)} <= set(some) and (0, 999) in some
