"""Frames of transforms.json and transforms_{train,val,test}.json: names, poses and intrinsics."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Distortion, Projection, transform_poses
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.intrinsics import Intrinsics, make_equirectangular
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

PERSPECTIVE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE_MODELS = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
EQUIRECTANGULAR_MODEL = "EQUIRECTANGULAR"
UNSUPPORTED_KEYS = (
    "k5",
    "k6",
    "s1",
    "s2",
    "s3",
    "s4",
    "rolling_shutter",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "latlong",
)
"""Keys of unsupported lens models; 0 and false are accepted."""
SUPPORTED_KEYS = {
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_model"),
    *("is_fisheye", "k1", "k2", "k3", "k4", "p1", "p2", *UNSUPPORTED_KEYS),
    *("frames", "file_path", "transform_matrix", "mask_path", "applied_transform", "applied_scale"),
    *("train_filenames", "val_filenames", "test_filenames"),
}  # fmt: skip
MIN_FOV_RAD = 1e-9


@dataclass(frozen=True)
class Frame:
    """One entry of `frames`."""

    where: str
    """File and index, for messages."""
    values: Mapping[str, Any]
    """Entries of the frame, with the file's top level as default."""
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV, world frame and unit of the capture."""

    @property
    def name(self) -> str:
        """Path of the photo in the file."""
        return str(self.values["file_path"])

    def get_number(self, key: str, default: float) -> float:
        """Gets a number, or the default if it is missing or null."""
        value = self.values.get(key)
        return default if value is None else checks.parse_number(self.where, key, value)


def opengl_to_opencv(c2w: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, "V 4 4"]:
    """Converts camera-to-world poses from OpenGL camera axes (y up, z backward) to OpenCV's (y down, z forward)."""
    return c2w * np.array([1.0, -1.0, -1.0, 1.0])


def read_frames(file: Path) -> list[Frame]:
    """Reads all frames of a JSON file in order. Unknown keys are logged.

    Raises:
        InputError: no frames, or invalid poses.
    """
    content = read_json(file, "a JSON object", "fix it or export again")
    if not isinstance(content, dict):
        raise InputError(file, "", f"a JSON {type(content).__name__}", "a JSON object with frames")
    checks.require_keys(file, content, ["frames"])
    entries = content["frames"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(file, "frames", repr(entries)[:60], "objects with file_path and transform_matrix")
    locations, poses = [f"{file}: frames[{i}]" for i in range(len(entries))], []
    for where, entry in zip(locations, entries, strict=True):
        checks.require_keys(where, entry, ["file_path", "transform_matrix"])
        if not isinstance(entry["file_path"], str):
            raise InputError(where, "file_path", repr(entry["file_path"])[:60], "a string")
        poses.append(parse_matrix(where, "transform_matrix", entry["transform_matrix"]))
    rigid = torch.from_numpy(opengl_to_opencv(checks.check_poses(file, "frames[{}].transform_matrix", np.stack(poses))))
    c2w = transform_poses(rigid, torch.from_numpy(invert_applied_transform(file, content))).numpy()
    if unused := sorted({*content, *(key for entry in entries for key in entry)} - SUPPORTED_KEYS):
        log.info("%s: ignoring unknown keys: %s", file, ", ".join(unused))
    entries = [{key: value for key, value in entry.items() if value is not None} for entry in entries]
    return [Frame(where, {**content, **x}, pose) for where, x, pose in zip(locations, entries, c2w, strict=True)]


def parse_matrix(where: object, key: str, value: Any) -> Float[np.ndarray, "4 4"]:
    """Parses a matrix of 3 or 4 rows of 4 numbers; the fourth row is 0 0 0 1 if absent."""
    matrix = checks.parse_floats(where, key, value)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(where, key, f"shape {matrix.shape}", "4 rows of 4 numbers")
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])[:4]


def invert_applied_transform(file: Path, content: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Similarity from the file's world frame to that of the capture.

    nerfstudio applies `applied_transform` to the capture, and then `applied_scale`; exports are in the capture's frame.
    """
    applied = parse_matrix(file, "applied_transform", content.get("applied_transform", np.eye(4)))
    applied[:3] *= checks.parse_number(file, "applied_scale", content.get("applied_scale", 1.0))
    return np.linalg.inv(checks.check_similarity(file, "applied_transform, applied_scale", applied))


def read_size(frame: Frame) -> tuple[int, int] | None:
    """Reads a camera's width and height in pixels; None if not stated."""
    width, height = round(frame.get_number("w", 0)), round(frame.get_number("h", 0))
    if min(width, height) < 0:
        raise InputError(frame.where, "w, h", f"{width}x{height}", "the pixels of a photo")
    return (width, height) if width and height else None


def read_intrinsics(frame: Frame, width: int, height: int) -> Intrinsics:
    """Reads the intrinsics of one frame, in pixels of photos of the given size."""
    model = frame.values.get("camera_model") or "OPENCV"
    if model not in (*PERSPECTIVE_MODELS, *FISHEYE_MODELS, EQUIRECTANGULAR_MODEL):
        expected = f"one of {', '.join((*PERSPECTIVE_MODELS, *FISHEYE_MODELS, EQUIRECTANGULAR_MODEL))}"
        raise InputError(frame.where, "camera_model", repr(model)[:60], expected)
    if model == EQUIRECTANGULAR_MODEL:
        if abs(width - 2 * height) > 2:
            found, expected = f"{model} of {width}x{height} pixels", "photos twice as wide as high, of all directions"
            raise InputError(frame.where, "camera_model", found, expected)
        return make_equirectangular(width, height)
    fisheye = model in FISHEYE_MODELS or bool(frame.values.get("is_fisheye"))
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    for key in UNSUPPORTED_KEYS if fisheye else (*UNSUPPORTED_KEYS, "k4"):
        value = frame.values.get(key)
        if any(value) if isinstance(value, list) else value not in (None, False, 0, "0"):
            expected = f"at most {', '.join(names)}"
            raise InputError(frame.where, key, repr(value)[:60], expected, "calibrate or export with only these")
    fx, fy = read_focal(frame, "x", width, fisheye), read_focal(frame, "y", height, fisheye)
    if not (fx := fx or fy) or not (fy := fy or fx):
        found = f"no focal length among [{', '.join(sorted(frame.values))}]"
        raise InputError(frame.where, "fl_x", found, "fl_x in pixels or camera_angle_x in radians")
    distortion = Distortion(**{key: frame.get_number(key, 0.0) for key in names})
    projection = Projection.FISHEYE if fisheye else Projection.PERSPECTIVE
    cx, cy = frame.get_number("cx", width / 2), frame.get_number("cy", height / 2)
    return checks.check_camera(frame.where, "", Intrinsics(width, height, fx, fy, cx, cy, distortion, projection))


def read_focal(frame: Frame, axis: str, side: int, fisheye: bool) -> float:
    """Reads a focal length in pixels: from `fl_x`, `camera_angle_x` (radians) or `x_fov` (degrees), in this order; else 0."""
    angle = frame.get_number(f"camera_angle_{axis}", math.radians(frame.get_number(f"{axis}_fov", 0.0)))
    if (focal := frame.get_number(f"fl_{axis}", 0.0)) or not angle:
        return focal
    if not MIN_FOV_RAD < angle < math.pi:
        raise InputError(frame.where, f"camera_angle_{axis}", f"{angle:g}", "a field of view in radians, below pi")
    return side / (angle if fisheye else 2 * math.tan(0.5 * angle))
