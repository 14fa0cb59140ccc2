"""Folders of photos that are damaged: one line for each, and nothing is written."""

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from nerf_lightning.dataset import Views, open_scene
from nerf_lightning.dataset.formats.colmap_model import read_model
from nerf_lightning.errors import InputError
from tests.dataset.colmap_files import cameras_of, photos, write_colmap, write_llff, write_transforms

Spoil = Callable[[Path], object]


@pytest.fixture(scope="session")
def views(ball_views_of: Callable[..., Views]) -> Views:
    return ball_views_of(4)


def cut(name: str, size: int) -> Spoil:
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:size])


def put(name: str, at: int, form: str, *values: object) -> Spoil:
    """Overwrites some bytes."""

    def apply(folder: Path) -> None:
        content = bytearray((folder / name).read_bytes())
        struct.pack_into("<" + form, content, at, *values)
        (folder / name).write_bytes(content)

    return apply


def replaced(name: str, old: str, new: str) -> Spoil:
    def apply(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return apply


def picture(name: str, *shape: int) -> Spoil:
    return lambda folder: imageio.imwrite(folder / name, np.zeros(shape, np.uint8))


def text(name: str, content: str) -> Spoil:
    return lambda folder: (folder / name).write_text(content)


def loop(folder: Path) -> None:
    """A link to itself in the place of the photos."""
    for file in (folder / "images").iterdir():
        file.unlink()
    (folder / "images").rmdir()
    (folder / "images").symlink_to("images")


def without_photos(folder: Path) -> None:
    for file in (folder / "images").iterdir():
        file.unlink()


def rows(change: Callable[[np.ndarray], np.ndarray]) -> Spoil:
    def apply(folder: Path) -> None:
        path = folder / "poses_bounds.npy"
        np.save(path, change(np.load(path)))

    return apply


def nan_in_row(array: np.ndarray) -> np.ndarray:
    array[2, 3] = np.nan
    return array


def flat_row(array: np.ndarray) -> np.ndarray:
    array[1, [0, 5, 10]] = 0
    return array


def changed(array: np.ndarray, column: int, value: float) -> np.ndarray:
    array[0, column] = value
    return array


def pickled(folder: Path) -> None:
    np.save(folder / "poses_bounds.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)


def frame(**entry: object) -> Spoil:
    def apply(folder: Path) -> None:
        path = folder / "transforms.json"
        content = json.loads(path.read_text())
        content["frames"][3].update(entry)
        path.write_text(json.dumps(content))

    return apply


MODEL = "sparse/0"
BINARY: dict[str, tuple[Spoil, str]] = {
    "cameras cut": (cut(f"{MODEL}/cameras.bin", 30), "cameras.bin: found 30 bytes where at least"),
    "cameras empty": (cut(f"{MODEL}/cameras.bin", 0), "cameras.bin: found 0 bytes where at least 8"),
    "images cut": (cut(f"{MODEL}/images.bin", 100), "images.bin: found 100 bytes"),
    "images cut in a name": (cut(f"{MODEL}/images.bin", 74), "images.bin: found a photo's name without an end"),
    "points cut": (cut(f"{MODEL}/points3D.bin", 40), "points3D.bin: found 40 bytes"),
    "endless count": (put(f"{MODEL}/images.bin", 0, "Q", 2**60), "images.bin: found"),
    "unknown camera model": (put(f"{MODEL}/cameras.bin", 12, "i", 99), "camera 1: found model number 99"),
    "size of no photo": (put(f"{MODEL}/cameras.bin", 16, "Q", 0), "camera 1: found 0x40 pixels"),
    "focal length nan": (
        put(f"{MODEL}/cameras.bin", 32, "d", math.nan),
        "camera 1: found nan, expected a focal length",
    ),
    "focal length negative": (
        put(f"{MODEL}/cameras.bin", 32, "d", -60.0),
        "camera 1: found -60, expected a focal length",
    ),
    "focal length beyond float": (
        put(f"{MODEL}/cameras.bin", 32, "d", 1e39),
        "camera 1: found 1e+39, expected a focal",
    ),
    "place on no sensor": (
        put(f"{MODEL}/cameras.bin", 48, "d", 1e39),
        "camera 1: found 1e+39, expected at most 8388608",
    ),
    "pose far off": (put(f"{MODEL}/images.bin", 44, "d", 1e300), "0000.png: found a camera at 1e+300"),
    "camera that is not there": (put(f"{MODEL}/images.bin", 68, "i", 77), "found camera 77 of 0000.png"),
    "pose nan": (put(f"{MODEL}/images.bin", 44, "d", math.nan), "0000.png: found a pose of nan"),
    "quaternion of no rotation": (put(f"{MODEL}/images.bin", 12, "4d", 0, 0, 0, 0), "0000.png: found a pose"),
    "no images": (lambda f: (f / MODEL / "images.bin").write_bytes(struct.pack("<Q", 0)), "images: found 0 photos"),
    "name that is no text": (put(f"{MODEL}/images.bin", 72, "B", 0xFF), "found a photo's name that is no UTF-8"),
    "no photos": (without_photos, "found '0000.png' not in"),
    "loop of links": (loop, "a photo for at least half of the images"),
    "1-pixel photo": (picture("images/0003.png", 1, 1, 3), "0003.png: found 1x1 pixels"),
    "thumbnail": (picture("images/0003.png", 2, 2, 3), "0003.png: found 2x2 pixels, expected 48x40"),
    "photo of another shape": (picture("images/0003.png", 48, 40, 3), "0003.png: found 40x48 pixels, expected 48x40"),
    "PNG that is text": (text("images/0003.png", "a photo"), "0003.png: found 7 bytes that are no image"),
    "photo cut": (cut("images/0003.png", 200), "0003.png: found"),
    "photo empty": (cut("images/0003.png", 0), "0003.png: found 0 bytes"),
    "mask that is text": (
        lambda f: ((f / "masks").mkdir(), text("masks/0003.png", "a mask")(f)),
        "masks/0003.png: found 6 bytes",
    ),
    "only cameras": (lambda f: (f / MODEL / "images.bin").unlink(), "found a folder with images, sparse"),
}
TEXT: dict[str, tuple[Spoil, str]] = {
    "cameras no numbers": (replaced(f"{MODEL}/cameras.txt", "48 40", "48 forty"), "cameras.txt: found 1 48 forty"),
    "camera model": (replaced(f"{MODEL}/cameras.txt", "PINHOLE", "EUCM"), "camera 1: found 'EUCM'"),
    "parameters": (replaced(f"{MODEL}/cameras.txt", "48 40", "48"), "camera 1: found 3 parameters, expected 4"),
    "image line": (text(f"{MODEL}/images.txt", "1 1 0 0 0\n\n"), "images.txt: found 1 1 0 0 0"),
    "image words": (text(f"{MODEL}/images.txt", "1 a b c d e f g 1 0.png\n\n"), "images.txt: found 1 a b c"),
    "duplicate names": (replaced(f"{MODEL}/images.txt", "0001.png", "0000.png"), "two photos named 0000.png"),
    "points": (text(f"{MODEL}/points3D.txt", "1 2\n"), "points3D.txt: found 1 2"),
    "binary in a text file": (put(f"{MODEL}/images.txt", 0, "4B", 255, 254, 0, 1), "found something that is no text"),
    "no images": (text(f"{MODEL}/images.txt", "# none\n"), "images: found 0 photos"),
}
LLFF: dict[str, tuple[Spoil, str]] = {
    "another count": (rows(lambda a: a[:-2]), "poses_bounds.npy: found 10 poses, but 12 in images"),
    "another shape": (rows(lambda a: a[:, :15]), "found shape (12, 15)"),
    "one row": (rows(lambda a: a[0]), "found shape (17,)"),
    "nan": (rows(nan_in_row), "row 2: found nan"),
    "no rotation": (rows(flat_row), "row 1: found R^T R"),
    "pose far off": (rows(lambda a: changed(a, 3, 1e39)), "row 0: found a camera at 1e+39"),
    "focal length of nothing": (rows(lambda a: changed(a, 14, 1e-300)), "row 0: found 1e-300, expected a focal"),
    "width beyond float": (rows(lambda a: changed(a, 9, 1e39)), "row 0: found a width of 1e+39"),
    "no focal length": (rows(lambda a: changed(a, 14, 0)), "row 0: found 0, expected a focal length"),
    "no rows": (rows(lambda a: a[:0]), "found no photo"),
    "text": (text("poses_bounds.npy", "poses"), "poses_bounds.npy: found something unreadable"),
    "pickled": (pickled, "poses_bounds.npy: found something unreadable"),
    "another shape of photo": (picture("images/0003.png", 48, 40, 3), "0003.png: found 40x48 pixels, expected 48x40"),
}
TRANSFORMS: dict[str, tuple[Spoil, str]] = {
    "no photos": (without_photos, "which is not there (nor are 11 more)"),
    "pose nan": (frame(transform_matrix=[[math.nan] * 4] * 4), "frames[3].transform_matrix: found nan"),
    "applied transform": (
        lambda f: replaced("transforms.json", '{"frames"', '{"applied_transform": [[1, 0], [0, 1]], "frames"')(f),
        "applied_transform: found shape (2, 2)",
    ),
    "mask of no name": (frame(mask_path=3), "frames[3].mask_path: found 3"),
    "fisheye that folds": (frame(camera_model="OPENCV_FISHEYE", k1=-5), "found a distortion that folds the photo over"),
}
CASES = [
    *[("binary", name, *case) for name, case in BINARY.items()],
    *[("text", name, *case) for name, case in TEXT.items()],
    *[("llff", name, *case) for name, case in LLFF.items()],
    *[("transforms", name, *case) for name, case in TRANSFORMS.items()],
]


def written(kind: str, folder: Path, views: Views) -> Path:
    names = photos(folder / "images", views)
    if kind == "llff":
        write_llff(folder / "poses_bounds.npy", views)
    elif kind == "transforms":
        write_transforms(folder / "transforms.json", views, [f"images/{name}" for name in names])
    else:
        write_colmap(folder / MODEL, views.cameras.c2w.numpy(), names, cameras_of(views), text=kind == "text")
    return folder


@pytest.mark.parametrize(("kind", "spoil", "words"), [pytest.param(k, s, w, id=f"{k}-{n}") for k, n, s, w in CASES])
def test_damage(kind: str, spoil: Spoil, words: str, views: Views, tmp_path: Path, says: Callable):
    folder = written(kind, tmp_path / "scene", views)
    assert len(open_scene(str(folder)).train) == 10
    spoil(folder)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError) as caught:
        open_scene(str(folder))
    says(caught.value, folder, words, ", expected ")
    assert sorted(tmp_path.rglob("*")) == before, "nothing is written"


@pytest.mark.parametrize("kind", ["binary", "text"])
def test_every_truncation_of_a_model_is_one_line(kind: str, views: Views, tmp_path: Path):
    folder = written(kind, tmp_path, views)
    for path in sorted((folder / MODEL).iterdir()):
        whole = path.read_bytes()
        refused = 0
        for size in range(0, len(whole), 1 + len(whole) // 40):
            path.write_bytes(whole[:size])
            try:
                read_model(folder / MODEL)
            except InputError as error:
                assert "\n" not in str(error)
                refused += 1
        assert refused > (20 if kind == "binary" else 0), "text may end after any line"
        path.write_bytes(whole)
