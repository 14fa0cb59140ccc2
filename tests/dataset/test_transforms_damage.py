"""nerfstudio captures that are damaged: one line for each."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from nerf_lightning.dataset import load_transforms
from nerf_lightning.errors import InputError
from tests.dataset.test_transforms import INTRINSICS, H, W, change, opengl_pose, write


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write(tmp_path / "Garden", INTRINSICS)


def _remove_most(capture: Path) -> None:
    for i in range(2, 10):
        (capture / f"images/{i:04d}.png").unlink()


def _first(**entry: object) -> Callable[[Path], None]:
    return lambda capture: change(capture, lambda c: c["frames"][0].update(entry))


def _top(**entry: object) -> Callable[[Path], None]:
    return lambda capture: change(capture, lambda c: c.update(entry))


def _pop(key: str) -> Callable[[Path], None]:
    return lambda capture: change(capture, lambda c: c.pop(key))


ALL = [f"images/{i:04d}.png" for i in range(12)]
DAMAGE = {
    "no json": (lambda c: (c / "transforms.json").unlink(), "transforms.json: found nothing there"),
    "most photos missing": (_remove_most, "found 'images/0002.png', which is not there (nor are 7 more)"),
    "focal missing": (lambda c: (_pop("fl_x")(c), _pop("fl_y")(c)), "fl_x: found no focal length among [cx, cy"),
    "focal null": (_top(fl_x=None, fl_y=None), "fl_x: found no focal length"),
    "focal negative": (_top(fl_y=-3), "fl_y: found -3, expected a positive"),
    "focal of a frame": (_first(fl_x=0), "frames[0].fl_x: found 0"),
    "angle": (lambda c: (_pop("fl_x")(c), _top(camera_angle_x=4.0)(c)), "camera_angle_x: found 4"),
    "centre text": (_top(cx="middle"), "cx: found 'middle'"),
    "distortion text": (_first(k1=[1]), "frames[0].k1: found [1]"),
    "distortion k4": (_top(k4=0.1), "k4: found 0.1"),
    "lens of a frame": (_first(camera_model="EUCM"), "frames[0].camera_model: found 'EUCM'"),
    "focal beyond float": (_top(fl_x=1e39), "fl_x: found 1e+39, expected a focal length of"),
    "focal of no angle": (_first(fl_y=1e9), "frames[0].fl_y: found 1e+09, expected a focal length of"),
    "focal of nothing": (_top(fl_x=1e-300), "fl_x: found 1e-300, expected a focal length of"),
    "angle of nothing": (
        lambda c: (_pop("fl_x")(c), _top(camera_angle_x=1e-300)(c)),
        "camera_angle_x: found 1e-300, expected the angle that a photo shows",
    ),
    "centre far off": (_top(cx=1e39), "cx: found 1e+39, expected at most 8388608 pixels"),
    "distortion beyond float": (_top(k1=1e300), "a distortion that folds the photo over"),
    "pose far off": (
        _first(transform_matrix=[[1, 0, 0, 1e39], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "frames[0].transform_matrix: found a camera at 1e+39, expected coordinates of at most 1e+12",
    ),
    "pose of huge numbers": (
        _first(transform_matrix=[[1e300, -1e300, 0, 0], [1e300, 1e300, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]),
        "frames[0].transform_matrix: found R^T R that is 1e+300 away from the identity",
    ),
    "folded over": (_top(k1=-3.0), "k1, k2, k3, p1, p2: found a distortion that folds the photo over"),
    "mask missing": (_first(mask_path="no.png"), "frames[0].mask_path: found 'no.png', which is not there"),
    "width": (_top(w=181), ".png: found 160x120 pixels, expected 181x120, the size of its camera"),
    "height of a frame": (_first(h=1), ".png: found 160x120 pixels, expected 160x1"),
    "image size": (
        lambda c: cv2.imwrite(str(c / "images/0004.png"), np.zeros((H, W + 9, 3), np.uint8)),
        "0004.png: found 169x120 pixels, expected 160x120",
    ),
    "scaled pose": (
        _first(transform_matrix=(opengl_pose(0) * [2, 1, 1, 1]).tolist()),
        "frames[0].transform_matrix: found R^T R that is 3 away from the identity",
    ),
    "unknown name": (_top(val_filenames=["images/x.png"]), "val_filenames: found 'images/x.png', which is no frame"),
    "names no list": (_top(val_filenames="images/0000.png"), "val_filenames: found 'images/0000.png'"),
    "leaking split": (
        _top(train_filenames=ALL, val_filenames=ALL[:1]),
        "val_filenames: found 'images/0000.png', which is in train_filenames too",
    ),
    "nothing to train on": (_top(val_filenames=ALL), "train split: found 0 views"),
    "one photo": (lambda c: change(c, lambda j: j.update(frames=j["frames"][:1])), "train split: found 0 views"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage(damage: str, capture: Path, says: Callable):
    spoil, words = DAMAGE[damage]
    spoil(capture)
    with pytest.raises(InputError) as caught:
        load_transforms(capture)
    says(caught.value, capture, words, ", expected ")
