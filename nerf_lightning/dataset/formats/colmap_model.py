"""Readers of COLMAP models: cameras (https://colmap.github.io/cameras.html), images and points3D, binary or text.

pycolmap is not used, since it aborts the process on damaged files, and training does not need it otherwise.
"""

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from nerf_lightning.cameras import Distortion, Projection
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_file

MODEL_FILES = ("cameras", "images", "points3D")
CAMERA_MODELS = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "THIN_PRISM_FISHEYE": (10, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s2"),
    "SIMPLE_FISHEYE": (14, "f cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
}
"""Id and parameters of each supported camera model; `k`, `p`, `d`, `s` as in `cameras.Distortion`."""
CAMERA_MODEL_NAMES = {number: name for name, (number, _) in CAMERA_MODELS.items()}
Record = tuple[Any, ...]
MAX_QUATERNION_ERROR = 1e-2
"""Largest deviation of a quaternion's norm from 1."""


@dataclass(frozen=True)
class RegisteredImage:
    """One registered photo."""

    name: str
    intrinsics: Intrinsics
    c2w: Float[np.ndarray, "4 4"]
    """Camera to world, OpenCV frame, the model's unit."""


def find_model_files(folder: Path) -> list[Path]:
    """Finds the cameras, images and points files of a model, preferring binary; empty without the first two."""
    for ending in (".bin", ".txt"):
        files = [folder / f"{name}{ending}" for name in MODEL_FILES]
        if files[0].is_file() and files[1].is_file():
            return files
    return []


def read_model(folder: Path) -> tuple[list[RegisteredImage], Float[np.ndarray, "P 3"]]:
    """Reads the registered photos and points of a sparse model, preferring binary files.

    Raises:
        InputError: damaged files, no photo, or an unsupported camera model.
    """
    files = find_model_files(folder)
    parsers = BINARY_PARSERS if files[0].suffix == ".bin" else TEXT_PARSERS
    cameras, photos, points = (
        _read_rows(file, parse) if file.is_file() else [] for file, parse in zip(files, parsers, strict=True)
    )
    intrinsics = {number: make_intrinsics(files[0], f"camera {number}", *camera) for number, *camera in cameras}
    if not photos:
        raise InputError(files[1], "", "0 photos", "at least one registered photo")
    images = []
    for name, camera, pose in photos:
        if camera not in intrinsics:
            raise InputError(files[1], name, f"its camera {camera} is missing from {files[0].name}")
        images.append(RegisteredImage(name, intrinsics[camera], invert_pose(files[1], name, np.array(pose))))
    if len({image.name for image in images}) < len(images):
        raise InputError(files[1], "", "two photos have one name", hint="rename one")
    xyz = np.array(points, np.float64).reshape(-1, 3)
    return images, xyz[(np.abs(xyz) <= checks.MAX_COORDINATE).all(1)]


def _read_rows(path: Path, parse: Callable[[Path], Iterator[Record]]) -> list[Record]:
    try:
        return list(parse(path))
    except InputError:
        raise
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(path, "", f"damaged ({error})", hint="copy it again") from error


def make_intrinsics(
    where: object, key: str, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> Intrinsics:
    """Converts a COLMAP camera."""
    names = list_parameters(where, key, model)
    if len(names) != len(parameters):
        raise InputError(where, key, f"{len(parameters)} parameters", f"{len(names)} of {model}: {' '.join(names)}")
    named = dict(zip(names, parameters, strict=True))
    focal = named.pop("f", 0.0)
    fx, fy, cx, cy = (named.pop(name, focal) for name in ("fx", "fy", "cx", "cy"))
    projection = Projection.FISHEYE if "FISHEYE" in model else Projection.PERSPECTIVE
    return checks.check_camera(where, key, Intrinsics(width, height, fx, fy, cx, cy, Distortion(**named), projection))


def list_parameters(where: object, key: str, model: str) -> list[str]:
    if model not in CAMERA_MODELS:
        raise InputError(where, key, f"camera model {model}", f"one of {', '.join(CAMERA_MODELS)}")
    return CAMERA_MODELS[model][1].split()


@np.errstate(all="ignore")
def invert_pose(path: Path, name: str, pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """Inverts a world-to-camera pose: quaternion (w, x, y, z) and translation."""
    is_unit = abs(np.linalg.norm(pose[:4]) - 1) < MAX_QUATERNION_ERROR
    if not is_unit or not (np.abs(pose[4:]) <= checks.MAX_COORDINATE).all():
        expected = f"a unit quaternion and a translation of at most {checks.MAX_COORDINATE:g}"
        raise InputError(path, name, f"the pose {pose.tolist()}", expected)
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix().T
    c2w[:3, 3] = -c2w[:3, :3] @ pose[4:]
    return c2w


class BinaryReader:
    """Reads records of a binary file; struct.error or ValueError if it is truncated."""

    def __init__(self, path: Path):
        self.content, self.offset = read_file(path), 0

    def read(self, form: str) -> Record:
        """Reads the next numbers, given in struct's notation, little-endian."""
        values = struct.unpack_from("<" + form, self.content, self.offset)
        self.offset += struct.calcsize("<" + form)
        return values

    def iterate_records(self) -> range:
        """Reads a count and iterates over it."""
        return range(self.read("Q")[0])

    def skip_records(self, size: int) -> None:
        count = len(self.iterate_records())
        self.offset += count * size

    def read_text(self) -> str:
        """Reads a zero-terminated string."""
        start, end = self.offset, self.content.index(b"\0", self.offset)
        self.offset = end + 1
        return self.content[start:end].decode()


def _parse_binary_cameras(path: Path) -> Iterator[Record]:
    """Yields id, model, width, height and parameters of each camera."""
    file = BinaryReader(path)
    for _ in file.iterate_records():
        number, model, width, height = file.read("iiQQ")
        name = CAMERA_MODEL_NAMES.get(model, f"number {model}")
        yield number, name, width, height, file.read(f"{len(list_parameters(path, f'camera {number}', name))}d")


def _parse_binary_images(path: Path) -> Iterator[Record]:
    """Yields name, camera id, and quaternion and translation of each photo."""
    file = BinaryReader(path)
    for _ in file.iterate_records():
        _, *pose, camera = file.read("i7di")
        yield file.read_text(), camera, pose
        file.skip_records(24)  # x, y and the point of each feature


def _parse_binary_points(path: Path) -> Iterator[Record]:
    file = BinaryReader(path)
    for _ in file.iterate_records():
        yield file.read("Q3d3Bd")[1:4]
        file.skip_records(8)  # the track


def _split_lines(path: Path) -> Iterator[str]:
    """Iterates over the lines without comments; keeps empty lines."""
    return (line for line in read_file(path).decode().splitlines() if not line.startswith("#"))


def _parse_text_cameras(path: Path) -> Iterator[Record]:
    for number, name, width, height, *parameters in filter(None, map(str.split, _split_lines(path))):
        yield int(number), name, int(width), int(height), tuple(map(float, parameters))


def _parse_text_images(path: Path) -> Iterator[Record]:
    lines = _split_lines(path)
    for line in filter(str.strip, lines):
        next(lines, None)  # every second line holds the features, and may be empty
        _, w, x, y, z, tx, ty, tz, camera, name = line.split(None, 9)  # names may contain spaces
        yield name.rstrip(), int(camera), list(map(float, (w, x, y, z, tx, ty, tz)))


def _parse_text_points(path: Path) -> Iterator[Record]:
    for _, x, y, z, *_ in filter(None, map(str.split, _split_lines(path))):
        yield float(x), float(y), float(z)


BINARY_PARSERS = (_parse_binary_cameras, _parse_binary_images, _parse_binary_points)
TEXT_PARSERS = (_parse_text_cameras, _parse_text_images, _parse_text_points)
