"""COLMAP's files: cameras (https://colmap.github.io/cameras.html), images and points3D, binary or text.

Read here, because pycolmap ends the process over a damaged file, and is not needed for anything else in training.
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
from nerf_lightning.utils.parsing import read_content

FILES = ("cameras", "images", "points3D")
MODELS = {
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
"""Number and parameters of each camera model that is read; `k`, `p`, `d`, `s` as in `cameras.Distortion`."""
MODEL_NAMES = {number: name for name, (number, _) in MODELS.items()}
Row = tuple[Any, ...]
MAX_NORM_ERROR = 1e-2
"""Of a pose's quaternion."""


@dataclass(frozen=True)
class Image:
    """One placed photo."""

    name: str
    optics: Intrinsics
    c2w: Float[np.ndarray, "4 4"]
    """Camera to world, OpenCV frame, the model's unit."""


def find_files(folder: Path) -> list[Path]:
    """Cameras, images and points of a model, the binary ones where there are both; none without the first two."""
    for ending in (".bin", ".txt"):
        files = [folder / f"{name}{ending}" for name in FILES]
        if files[0].is_file() and files[1].is_file():
            return files
    return []


def read_model(folder: Path) -> tuple[list[Image], Float[np.ndarray, "P 3"]]:
    """Reads a sparse model, the binary files where there are both: its photos, and its points, if it has any.

    Raises:
        InputError: damaged files, no photo, or a camera model that is not known here.
    """
    files = find_files(folder)
    parsers = BINARY if files[0].suffix == ".bin" else TEXT
    cameras, photos, points = (
        _read_rows(file, parse) if file.is_file() else [] for file, parse in zip(files, parsers, strict=True)
    )
    optics = {number: make_optics(files[0], f"camera {number}", *camera) for number, *camera in cameras}
    if not photos:
        raise InputError(files[1], "", "0 photos", "at least one placed photo")
    images = []
    for name, camera, pose in photos:
        if camera not in optics:
            expected = "a camera of the model's cameras file"
            raise InputError(files[1], name, f"camera {camera}, which is not there", expected)
        images.append(Image(name, optics[camera], invert_pose(files[1], name, np.array(pose))))
    if len({image.name for image in images}) < len(images):
        raise InputError(files[1], "", "two photos of one name", "a name of its own for each")
    places = np.array(points, np.float64).reshape(-1, 3)
    return images, places[(np.abs(places) <= checks.FARTHEST).all(1)]


def _read_rows(path: Path, parse: Callable[[Path], Iterator[Row]]) -> list[Row]:
    try:
        return list(parse(path))
    except InputError:
        raise
    except (struct.error, ValueError, OverflowError) as error:
        raise InputError(path, "", f"a damaged file ({error})", "a whole COLMAP file", "copy it again") from error


def make_optics(
    where: object, key: str, model: str, width: int, height: int, parameters: tuple[float, ...]
) -> Intrinsics:
    """A camera in COLMAP's terms."""
    names = parameter_names(where, key, model)
    if len(names) != len(parameters):
        raise InputError(where, key, f"{len(parameters)} parameters", f"{len(names)} of {model}: {' '.join(names)}")
    named = dict(zip(names, parameters, strict=True))
    focal = named.pop("f", 0.0)
    fx, fy, cx, cy = (named.pop(name, focal) for name in ("fx", "fy", "cx", "cy"))
    projection = Projection.FISHEYE if "FISHEYE" in model else Projection.PERSPECTIVE
    return checks.check_optics(where, key, Intrinsics(width, height, fx, fy, cx, cy, Distortion(**named), projection))


def parameter_names(where: object, key: str, model: str) -> list[str]:
    if model not in MODELS:
        raise InputError(where, key, f"camera model {model}", f"one of {', '.join(MODELS)}")
    return MODELS[model][1].split()


@np.errstate(all="ignore")
def invert_pose(path: Path, name: str, pose: Float[np.ndarray, "7"]) -> Float[np.ndarray, "4 4"]:
    """Camera to world, from a world-to-camera pose: quaternion (w, x, y, z) and translation."""
    is_unit = abs(np.linalg.norm(pose[:4]) - 1) < MAX_NORM_ERROR
    if not is_unit or not (np.abs(pose[4:]) <= checks.FARTHEST).all():
        expected = f"a unit quaternion and a translation of at most {checks.FARTHEST:g}"
        raise InputError(path, name, f"the pose {pose.tolist()}", expected)
    c2w = np.eye(4)
    c2w[:3, :3] = Rotation.from_quat(pose[[1, 2, 3, 0]]).as_matrix().T
    c2w[:3, 3] = -c2w[:3, :3] @ pose[4:]
    return c2w


class Bytes:
    """Reads records of a binary file; struct.error or ValueError where it ends before."""

    def __init__(self, path: Path):
        self.content, self.at = read_content(path), 0

    def take(self, form: str) -> Row:
        """The next numbers, in struct's notation, little-endian."""
        found = struct.unpack_from("<" + form, self.content, self.at)
        self.at += struct.calcsize("<" + form)
        return found

    def records(self) -> range:
        """As many as the next number says."""
        return range(self.take("Q")[0])

    def skip_records(self, size: int) -> None:
        count = len(self.records())
        self.at += count * size

    def text(self) -> str:
        """A name that ends with a zero byte."""
        start, end = self.at, self.content.index(b"\0", self.at)
        self.at = end + 1
        return self.content[start:end].decode()


def _cameras_bin(path: Path) -> Iterator[Row]:
    """Number, model, width, height and parameters of each camera."""
    file = Bytes(path)
    for _ in file.records():
        number, model, width, height = file.take("iiQQ")
        name = MODEL_NAMES.get(model, f"number {model}")
        yield number, name, width, height, file.take(f"{len(parameter_names(path, f'camera {number}', name))}d")


def _images_bin(path: Path) -> Iterator[Row]:
    """Name, number of the camera, and quaternion and translation of each photo."""
    file = Bytes(path)
    for _ in file.records():
        _, *pose, camera = file.take("i7di")
        yield file.text(), camera, pose
        file.skip_records(24)  # x, y and the point of each feature


def _points_bin(path: Path) -> Iterator[Row]:
    file = Bytes(path)
    for _ in file.records():
        yield file.take("Q3d3Bd")[1:4]
        file.skip_records(8)  # the images that see it


def _lines(path: Path) -> Iterator[str]:
    """All lines but comments, empty ones too."""
    return (line for line in read_content(path).decode().splitlines() if not line.startswith("#"))


def _cameras_txt(path: Path) -> Iterator[Row]:
    for number, name, width, height, *parameters in filter(None, map(str.split, _lines(path))):
        yield int(number), name, int(width), int(height), tuple(map(float, parameters))


def _images_txt(path: Path) -> Iterator[Row]:
    lines = _lines(path)
    for line in filter(str.strip, lines):
        next(lines, None)  # every second line holds the features, and may be empty
        _, w, x, y, z, tx, ty, tz, camera, name = line.split(None, 9)  # names may contain spaces
        yield name.rstrip(), int(camera), list(map(float, (w, x, y, z, tx, ty, tz)))


def _points_txt(path: Path) -> Iterator[Row]:
    for _, x, y, z, *_ in filter(None, map(str.split, _lines(path))):
        yield float(x), float(y), float(z)


BINARY = (_cameras_bin, _images_bin, _points_bin)
TEXT = (_cameras_txt, _images_txt, _points_txt)
