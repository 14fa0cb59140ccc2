"""Damaged scenes of each format: one line that says what is wrong, nothing is written and nothing executed."""

import json
import math
import os
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from nerf_lightning.dataset import Views, open_scene
from nerf_lightning.errors import InputError
from tests.helpers.scene_writers import write_scene

Spoil = Callable[[Path], object]
MODEL = "sparse/0"
EYE = np.eye(4)


def cut(name: str, size: int) -> Spoil:
    return lambda scene: (scene / name).write_bytes((scene / name).read_bytes()[:size])


def put(name: str, at: int, form: str, *values: object) -> Spoil:
    """Overwrites bytes."""

    def apply(scene: Path) -> None:
        content = bytearray((scene / name).read_bytes())
        struct.pack_into("<" + form, content, at, *values)
        (scene / name).write_bytes(content)

    return apply


def text(name: str, content: str) -> Spoil:
    return lambda scene: ((scene / name).parent.mkdir(exist_ok=True), (scene / name).write_text(content))


def replaced(name: str, old: str, new: str) -> Spoil:
    return lambda scene: (scene / name).write_text((scene / name).read_text().replace(old, new, 1))


def picture(name: str, *shape: int) -> Spoil:
    return lambda scene: imageio.imwrite(scene / name, np.zeros(shape, np.uint8))


def no_photos(scene: Path) -> None:
    for file in (scene / "images").iterdir():
        file.unlink()


def entries(**changes: object) -> Spoil:
    """Changes entries of the .npz file; None removes one, a function maps the old one."""

    def apply(file: Path) -> None:
        with np.load(file) as content:
            arrays = dict(content)
        for key, value in changes.items():
            arrays[key] = value(arrays[key]) if callable(value) else value
        np.savez(file, **{key: value for key, value in arrays.items() if value is not None})

    return apply


def pose(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return entries(c2ws_train=lambda poses: np.concatenate([poses[:1], change(poses[1])[None], poses[2:]]))


def edit(change: Callable[[dict], object]) -> Spoil:
    """Changes the JSON file with the most frames."""

    def apply(scene: Path) -> None:
        file = next(scene / name for name in ("transforms.json", "transforms_train.json") if (scene / name).exists())
        content = json.loads(file.read_text())
        change(content)
        file.write_text(json.dumps(content))

    return apply


def frame(**keys: object) -> Spoil:
    return edit(lambda c: c["frames"][3].update(keys))


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    return lambda scene: np.save(scene / "poses_bounds.npy", change(np.load(scene / "poses_bounds.npy")))


def cell(row: int, columns: object, value: float) -> Spoil:
    return rows(lambda array: (array.__setitem__((row, columns), value), array)[1])


class Payload:
    """Makes a folder when unpickled."""

    def __reduce__(self):
        return (os.mkdir, ("executed",))


PICKLED = np.array([Payload()], dtype=object)
ALL = [f"images/{i:04d}.png" for i in range(12)]
NPZ = [
    (entries(images_train=None), "images_train: missing"),
    (entries(images_val=lambda x: x * 1.0), "floats from"),
    (entries(images_val=lambda x: x[:, :4]), "as in images_train"),
    (entries(images_val=lambda x: x[:0], c2ws_val=lambda x: x[:0]), "0 views"),
    (entries(c2ws_train=lambda x: x[:2]), "9 images for 2 poses"),
    (pose(lambda p: p * np.nan), "c2ws_train[1]: found nan"),
    (pose(lambda p: p * [2, 2, 3, 1]), "c2ws_train[1]: found shear"),
    (pose(lambda p: p * [-1, 1, 1, 1]), "c2ws_train[1]: found a mirror"),
    (pose(lambda p: p.T), "c2ws_train[1]: found another bottom row"),
    (pose(lambda p: p + 1e30 * np.eye(4, k=3)), "c2ws_train[1]: found a camera farther"),
    (entries(focal=-3.0), "focal: found [[-3"),
    (entries(K=[[60.0, 0, 1e9], [0, 60, 3], [0, 0, 1]]), "no number above"),
    (entries(K=[[600.0, 0, 240], [0, 600, 200], [0, 0, 1]]), "the middle of photos 10 times the size"),
    (entries(near=3.0, far=2.0), "far: found 2"),
    (entries(aabb=[[1.0, 1, 1], [0, 2, 2]]), "aabb: found"),
    (entries(to_source=EYE + np.eye(4, k=1) * [0, 1, 0, 0]), "a similarity"),
    (entries(background=[0, 2, 0.5]), "background: found"),
    (entries(focal=PICKLED), "Object arrays"),
    (entries(c2ws_train=lambda x: x * np.array([*[[1, 1, 1, 1e-14]] * 3, [1] * 4])), "change the unit"),
    (lambda file: file.write_bytes(file.read_bytes()[:-200]), "BadZipFile"),
]
JSON = [
    (text("transforms.json", '{"frames": [}'), "unreadable as"),
    (edit(lambda c: c.pop("frames")), "frames: missing"),
    (frame(file_path=3), "frames[3]: file_path: found 3"),
    (frame(transform_matrix=np.eye(3).tolist()), "frames[3]: transform_matrix: found shape"),
    (frame(transform_matrix=[[math.nan] * 4] * 4), "frames[3].transform_matrix: found nan"),
    (frame(mask_path="no.png"), "no such file"),
    (no_photos, "and 11 more of 12 photos"),
    (frame(fl_x=None, fl_y=None), "no focal length"),
    (frame(fl_x=None, fl_y=None, camera_angle_x=62.0), "radians"),
    (frame(k1=-50.0), "is not invertible"),
    (frame(k4=0.1), "k4: found 0.1"),
    (frame(rolling_shutter=[0, 0, 0.03, 0]), "rolling_shutter: found"),
    (frame(w=60, h=40), "found 48x40 pixels, expected 60x40"),
    (edit(lambda c: c.update(val_filenames=["images/x.png"])), "which is not a frame"),
    (edit(lambda c: c.update(train_filenames=ALL, val_filenames=ALL[:1])), "which is also in train_filenames"),
]
BLENDER = [
    (edit(lambda c: c.pop("camera_angle_x")), "no focal length"),
    (text("images/0005.png", "no"), "0005.png: no readable"),
]
COLMAP = [
    (cut(f"{MODEL}/cameras.bin", 30), "cameras.bin: damaged"),
    (put(f"{MODEL}/images.bin", 0, "Q", 2**60), "images.bin: damaged"),
    (put(f"{MODEL}/cameras.bin", 12, "i", 99), "model number 99"),
    (put(f"{MODEL}/cameras.bin", 32, "d", math.nan), "camera 1: found nan"),
    (put(f"{MODEL}/images.bin", 44, "d", math.nan), "0000.png: found the pose"),
    (put(f"{MODEL}/images.bin", 68, "i", 77), "0000.png: its camera 77"),
    (lambda scene: (scene / MODEL / "images.bin").write_bytes(bytes(8)), "0 photos"),
    (lambda scene: (scene / MODEL / "images.bin").unlink(), "a folder without a scene"),
    (no_photos, "and 11 more of 12 photos"),
    (picture("images/0003.png", 48, 40, 3), "0003.png: found 40x48 pixels, expected 48x40"),
    (cut("images/0003.png", 200), "0003.png: no readable image"),
    (text("masks/0003.png", "a mask"), "masks/0003.png: no readable"),
]
TEXT = [
    (replaced(f"{MODEL}/cameras.txt", "48 40", "48 forty"), "forty"),
    (replaced(f"{MODEL}/cameras.txt", "PINHOLE", "EUCM"), "camera model EUCM"),
    (text(f"{MODEL}/images.txt", "1 1 0 0 0\n\n"), "images.txt: damaged"),
    (replaced(f"{MODEL}/images.txt", "0001.png", "0000.png"), "two photos have one name"),
    (text(f"{MODEL}/points3D.txt", "1 2\n"), "points3D.txt: damaged"),
]
LLFF = [
    (rows(lambda a: a[:-2]), "10 poses, but 12 in images"),
    (cell(2, 3, np.nan), "row 2: found nan"),
    (cell(0, 14, 1e-300), "focal lengths of at least"),
    (lambda scene: np.save(scene / "poses_bounds.npy", PICKLED, allow_pickle=True), "unreadable"),
]
TABLES = {"npz": NPZ, "transforms": JSON, "blender": BLENDER, "colmap": COLMAP, "text": TEXT, "llff": LLFF}
CASES = [(format, *case) for format, cases in TABLES.items() for case in cases]


@pytest.fixture(scope="module")
def whole(ball_views_of: Callable[..., Views], tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The same 12 views in each format; all can be opened."""
    folder, views = tmp_path_factory.mktemp("whole"), ball_views_of(4)
    scenes = {format: write_scene(format, folder / format, views) for format in TABLES}
    assert {len(open_scene(str(scene)).train) for scene in scenes.values()} == {9, 10}
    return scenes


@pytest.mark.parametrize(("format", "spoil", "words"), CASES, ids=[f"{case[0]}-{case[2]}" for case in CASES])
def test_open_scene_of_damaged_files_raises_one_line(
    format: str, spoil: Spoil, words: str, whole: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(whole[format].parent if format == "npz" else whole[format], tmp_path / "scene")
    scene = tmp_path / "scene" / whole[format].name if format == "npz" else tmp_path / "scene"
    spoil(scene)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as caught:
        open_scene(str(scene))
    line = str(caught.value)
    assert "\n" not in line and str(scene) in line and words in line, line
    assert sorted(tmp_path.rglob("*")) == before, "nothing is written or executed"
