"""COLMAP's files: cameras, images and points3D, binary or text.

Read here, because pycolmap ends the process over a damaged file, and is not needed for anything else in training.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.colmap_cameras import MODELS, NUMBERS, optics_of
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_content

FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True)
class Image:
    """One placed photo."""

    name: str
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    """Camera to world, OpenCV frame, the model's unit."""


@dataclass(frozen=True)
class Model:
    """A sparse model."""

    cameras: dict[int, Optics]
    images: list[Image]
    points: Float[np.ndarray, "P 3"]
    """Empty where the model has no points3D file."""


def holds_model(folder: Path) -> bool:
    """Whether there are cameras and images of a model, both binary or both text."""
    return any(all((folder / f"{name}{end}").is_file() for name in FILES[:2]) for end in (".bin", ".txt"))


def count_images(folder: Path) -> int:
    """How many photos a model has, without reading it all."""
    path = folder / "images.bin"
    if path.is_file():
        with path.open("rb") as file:
            head = file.read(8)
        return struct.unpack("<Q", head)[0] if len(head) == 8 else 0
    return sum(1 for _ in _image_lines(folder / "images.txt"))


def read_model(folder: Path) -> Model:
    """Reads a sparse model; the binary files where there are both.

    Raises:
        InputError: damaged files, or a camera model that is not known here.
    """
    binary = all((folder / f"{name}.bin").is_file() for name in FILES[:2])
    cameras_of, images_of, points_of = (
        (_cameras_bin, _images_bin, _points_bin) if binary else (_cameras_txt, _images_txt, _points_txt)
    )
    cameras_file, images_file, points_file = (folder / f"{name}{'.bin' if binary else '.txt'}" for name in FILES)
    cameras: dict[int, Optics] = {}
    images: list[Image] = []
    path = cameras_file
    try:
        for number, model, width, height, parameters in cameras_of(path):
            key = f"camera {number}"
            cameras[number] = optics_of(path, key, model, width, height, tuple(parameters))
        path = images_file
        for name, camera, pose in images_of(path):
            images.append(Image(name, camera, _pose(path, name, np.array(pose))))
        path = points_file
        points = np.array(list(points_of(path)) if path.is_file() else [], np.float64).reshape(-1, 3)
    except (struct.error, ValueError, OverflowError, IndexError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "", f"a damaged file ({error})", "a whole COLMAP file", "copy it again") from error
    return Model(cameras, images, points[(np.abs(points) <= checks.FARTHEST).all(1)])


def _pose(path: Path, name: str, numbers: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """Camera to world, from the world-to-camera pose: a quaternion (w, x, y, z) and a translation."""
    w, x, y, z = numbers[:4]
    if (
        not (np.abs(numbers[4:]) <= checks.FARTHEST).all()
        or not abs(np.linalg.norm(numbers[:4].clip(-9, 9)) - 1) < 1e-2
    ):
        expected = f"a unit quaternion and a translation of at most {checks.FARTHEST:g}"
        raise InputError(path, name, f"the pose {numbers.tolist()}", expected)
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix().T
    c2w[:3, 3] = -c2w[:3, :3] @ numbers[4:]
    return c2w


class Bytes:
    """Reads numbers from a file's content, one after the other; struct.error where it ends before."""

    def __init__(self, path: Path):
        self.content = read_content(path)
        self.at = 0

    def take(self, form: str) -> tuple:
        """The next numbers, in struct's notation, little-endian."""
        found = struct.unpack_from("<" + form, self.content, self.at)
        self.skip(struct.calcsize("<" + form))
        return found

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.content):
            raise struct.error(f"{len(self.content)} bytes where at least {self.at} are needed")

    def text(self) -> str:
        """A name that ends with a zero byte."""
        start, end = self.at, self.content.index(b"\0", self.at)
        self.at = end + 1
        return self.content[start:end].decode()


Camera = tuple[int, str, int, int, tuple[float, ...]]
"""Number, model, width, height and parameters."""
Placed = tuple[str, int, tuple[float, ...]]
"""A photo's name, the number of its camera, its quaternion and translation."""


def _cameras_bin(path: Path) -> Iterator[Camera]:
    file = Bytes(path)
    for _ in range(file.take("Q")[0]):
        number, model, width, height = file.take("iiQQ")
        if model not in MODELS:
            raise InputError(path, f"camera {number}", f"model number {model}", f"one of {', '.join(NUMBERS)}")
        name, count = MODELS[model]
        yield number, name, width, height, file.take(f"{count}d")


def _images_bin(path: Path) -> Iterator[Placed]:
    file = Bytes(path)
    for _ in range(file.take("Q")[0]):
        _, *pose, camera = file.take("i7di")
        name = file.text()
        file.skip(24 * file.take("Q")[0])  # x, y and the point of each feature
        yield name, camera, tuple(pose)


def _points_bin(path: Path) -> Iterator[tuple[float, ...]]:
    file = Bytes(path)
    for _ in range(file.take("Q")[0]):
        yield file.take("Q3d3Bd")[1:4]
        file.skip(8 * file.take("Q")[0])  # the images that see it


def _lines(path: Path, splits: int = -1) -> Iterator[list[str]]:
    """The words of each line but comments, the rest of a line after that many splits whole; empty lines too."""
    try:
        text = read_content(path).decode()
    except UnicodeDecodeError as error:
        raise InputError(path, "", f"no text ({error})", "COLMAP's text format") from error
    for line in text.splitlines():
        if not line.startswith("#"):
            yield line.split(None, splits)


def _image_lines(path: Path) -> Iterator[list[str]]:
    """Every second line: those between hold the features, and may be empty."""
    lines = _lines(path, splits=9)  # names may contain spaces
    for words in lines:
        if words:
            yield words
            next(lines, None)


def _cameras_txt(path: Path) -> Iterator[Camera]:
    for words in filter(None, _lines(path)):
        number, name, width, height, *parameters = words
        if name not in NUMBERS:
            raise InputError(path, f"camera {number}", repr(name), f"one of {', '.join(NUMBERS)}")
        count = MODELS[NUMBERS[name]][1]
        if len(parameters) != count:
            raise InputError(path, f"camera {number}", f"{len(parameters)} parameters", f"{count} of {name}")
        yield int(number), name, int(width), int(height), tuple(map(float, parameters))


def _images_txt(path: Path) -> Iterator[Placed]:
    for words in _image_lines(path):
        _, *pose, camera, name = words
        if len(pose) != 7:
            raise ValueError(" ".join(words)[:60])
        yield name.rstrip(), int(camera), tuple(map(float, pose))


def _points_txt(path: Path) -> Iterator[tuple[float, ...]]:
    for words in filter(None, _lines(path)):
        _, x, y, z = words[:4]
        yield float(x), float(y), float(z)
