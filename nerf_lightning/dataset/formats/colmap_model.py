"""COLMAP's files: cameras, images and points3D, binary or text.

Read here, because pycolmap ends the process over a damaged file, and is not needed for anything else in training.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.colmap_cameras import MODELS, NUMBERS, optics_of
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_content

FILES = ("cameras", "images", "points3D")
LONGEST_NAME = 4096


@dataclass(frozen=True)
class Image:
    """One placed photo."""

    number: int
    name: str
    camera: int
    w2c: Float[np.ndarray, "4 4"]
    """World to camera, OpenCV frame, the model's unit."""


@dataclass(frozen=True)
class Model:
    """A sparse model."""

    cameras: dict[int, Optics]
    images: list[Image]
    points: Float[np.ndarray, "P 3"]
    """Empty where the model has no points3D file."""


class Bytes:
    """Reads numbers from a file's content, one after the other.

    Raises:
        InputError: the file ends before.
    """

    def __init__(self, path: Path):
        self.path = path
        self.content = read_content(path)
        self.at = 0

    def take(self, form: str) -> tuple:
        """The next numbers, in struct's notation, little-endian."""
        size = struct.calcsize("<" + form)
        self.skip(size)
        return struct.unpack_from("<" + form, self.content, self.at - size)

    def skip(self, size: int) -> None:
        if self.at + size > len(self.content):
            found = f"{len(self.content)} bytes where at least {self.at + size} are needed"
            raise InputError(self.path, "", found, "a whole binary COLMAP file", "copy it again")
        self.at += size

    def text(self) -> str:
        """A name that ends with a zero byte."""
        end = self.content.find(b"\0", self.at, self.at + LONGEST_NAME)
        if end < 0:
            raise InputError(self.path, "", "a photo's name without an end", "a whole binary COLMAP file")
        raw, self.at = self.content[self.at : end], end + 1
        try:
            return raw.decode()
        except UnicodeDecodeError as error:
            raise InputError(self.path, "", "a photo's name that is no UTF-8", "a binary COLMAP file") from error


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
    end = ".bin" if binary else ".txt"
    paths = [folder / (name + end) for name in FILES]
    readers = (_cameras_bin, _images_bin, _points_bin) if binary else (_cameras_txt, _images_txt, _points_txt)
    cameras = readers[0](paths[0])
    images = readers[1](paths[1])
    points = readers[2](paths[2]) if paths[2].is_file() else np.zeros((0, 3))
    return Model(cameras, images, points[(np.abs(points) <= checks.FARTHEST).all(1)])


@np.errstate(over="ignore")
def _pose(path: Path, name: str, numbers: tuple[float, ...]) -> Float[np.ndarray, "4 4"]:
    """World to camera from a quaternion (w, x, y, z) and a translation."""
    q = np.array(numbers[:4])
    if not np.isfinite(numbers).all() or not abs(np.linalg.norm(q) - 1) < 1e-2:
        raise InputError(path, name, "a pose of nan, infinity or no rotation", "a unit quaternion and a translation")
    w, x, y, z = q / np.linalg.norm(q)
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = numbers[4:]
    return pose


def _cameras_bin(path: Path) -> dict[int, Optics]:
    file = Bytes(path)
    cameras = {}
    for _ in range(file.take("Q")[0]):
        number, model, width, height = file.take("iiQQ")
        if model not in MODELS:
            raise InputError(path, f"camera {number}", f"model number {model}", f"one of {', '.join(NUMBERS)}")
        name, count = MODELS[model]
        cameras[number] = optics_of(path, f"camera {number}", name, width, height, file.take(f"{count}d"))
    return cameras


def _images_bin(path: Path) -> list[Image]:
    file = Bytes(path)
    images = []
    for _ in range(file.take("Q")[0]):
        number, *pose, camera = file.take("i7di")
        name = file.text()
        file.skip(24 * file.take("Q")[0])  # x, y and the point of each feature
        images.append(Image(number, name, camera, _pose(path, name, tuple(pose))))
    return images


def _points_bin(path: Path) -> Float[np.ndarray, "P 3"]:
    file = Bytes(path)
    points = []
    for _ in range(file.take("Q")[0]):
        points.append(file.take("Q3d3Bd")[1:4])
        file.skip(8 * file.take("Q")[0])  # the images that see it
    return np.array(points).reshape(-1, 3)


def _lines(path: Path, splits: int = -1) -> Iterator[list[str]]:
    """The words of each line but comments, the rest of a line after that many splits whole; empty lines too."""
    try:
        text = read_content(path).decode()
    except UnicodeDecodeError as error:
        raise InputError(path, "", "something that is no text", "COLMAP's text format") from error
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


def _numbers(path: Path, words: list[str]) -> tuple[float, ...]:
    try:
        return tuple(map(float, words))
    except ValueError as error:
        raise InputError(path, "", " ".join(words)[:60], "numbers, as COLMAP's text format has them") from error


def _cameras_txt(path: Path) -> dict[int, Optics]:
    cameras = {}
    for words in filter(None, _lines(path)):
        name = words[1] if len(words) > 1 else ""
        if name not in NUMBERS:
            raise InputError(path, f"camera {words[0]}", repr(name), f"one of {', '.join(NUMBERS)}")
        number, width, height, *p = _whole(path, [words[0], *words[2:]])
        count = MODELS[NUMBERS[name]][1]
        if len(p) != count:
            raise InputError(path, f"camera {words[0]}", f"{len(p)} parameters", f"{count} of {name}")
        cameras[int(number)] = optics_of(path, f"camera {words[0]}", name, int(width), int(height), tuple(p))
    return cameras


def _whole(path: Path, words: list[str]) -> tuple[float, ...]:
    numbers = _numbers(path, words)
    if len(numbers) < 3 or not all(map(math.isfinite, numbers)):
        raise InputError(path, "", " ".join(words)[:60], "number, model, width, height and parameters of a camera")
    return numbers


def _images_txt(path: Path) -> list[Image]:
    images = []
    for words in _image_lines(path):
        if len(words) < 10:
            raise InputError(
                path, "", " ".join(words)[:60], "number, quaternion, translation, camera and name of a photo"
            )
        number, *pose, camera = _numbers(path, words[:9])
        if not (math.isfinite(number) and math.isfinite(camera)):
            raise InputError(path, "", " ".join(words)[:60], "whole numbers of the photo and its camera")
        name = words[9].rstrip()
        images.append(Image(int(number), name, int(camera), _pose(path, name, tuple(pose))))
    return images


def _points_txt(path: Path) -> Float[np.ndarray, "P 3"]:
    points = []
    for words in filter(None, _lines(path)):
        if len(words) < 4:
            raise InputError(path, "", " ".join(words)[:60], "number and place of a point")
        points.append(_numbers(path, words[1:4]))
    return np.array(points).reshape(-1, 3)
