"""The frames of transforms.json and transforms_{train,val,test}.json: names, poses and intrinsics."""

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Distortion, Projection, in_other_frame
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.intrinsics import Intrinsics, equirectangular
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
EQUIRECTANGULAR = "EQUIRECTANGULAR"
REFUSED = ("k5", "k6", "s1", "s2", "s3", "s4", "rolling_shutter", "ftheta_p0", "ftheta_p1", "ftheta_p2", "latlong")
"""Keys that bend rays in ways that no lens here does; 0 and false are no lens."""
USED = {
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_model"),
    *("is_fisheye", "k1", "k2", "k3", "k4", "p1", "p2", *REFUSED),
    *("frames", "file_path", "transform_matrix", "mask_path", "applied_transform", "applied_scale"),
    *("train_filenames", "val_filenames", "test_filenames"),
}  # fmt: skip
MIN_ANGLE = 1e-9
"""Of view, radians."""


@dataclass(frozen=True)
class Frame:
    """One entry of `frames`."""

    where: str
    """File and index, for messages."""
    values: Mapping[str, Any]
    """What the entry says, or else the file of all frames."""
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV, the capture's world frame and unit."""

    @property
    def name(self) -> str:
        """Of the photo."""
        return str(self.values["file_path"])

    def number(self, key: str) -> float | None:
        """A number, if it is there."""
        value = self.values.get(key)
        return None if value is None else checks.parse_number(self.where, key, value)


def opengl_to_opencv(c2w: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, "V 4 4"]:
    """Camera to world from OpenGL's camera frame (x right, y up, z backward) to OpenCV's (y down, z forward)."""
    return c2w * np.array([1.0, -1.0, -1.0, 1.0])


def read_frames(file: Path) -> list[Frame]:
    """All frames of a JSON file in its order. Unknown keys are listed once.

    Raises:
        InputError: no frames, or poses that are none.
    """
    content = read_json(file, "a JSON object", "mend it or export again")
    if not isinstance(content, dict):
        raise InputError(file, "", f"a JSON {type(content).__name__}", "a JSON object with frames")
    checks.require_keys(file, content, ["frames"])
    entries = content["frames"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(file, "frames", repr(entries)[:60], "objects with file_path and transform_matrix")
    poses = []
    for i, entry in enumerate(entries):
        checks.require_keys(f"{file}: frames[{i}]", entry, ["file_path", "transform_matrix"])
        if not isinstance(entry["file_path"], str):
            raise InputError(f"{file}: frames[{i}]", "file_path", repr(entry["file_path"])[:60], "a string")
        poses.append(parse_matrix(f"{file}: frames[{i}]", "transform_matrix", entry["transform_matrix"]))
    rigid = checks.check_poses(file, "frames[{}].transform_matrix", np.stack(poses))
    c2w = in_other_frame(
        torch.from_numpy(opengl_to_opencv(rigid)), torch.from_numpy(undo_applied(file, content))
    ).numpy()
    if unused := sorted({*content, *(key for entry in entries for key in entry)} - USED):
        log.info("%s: keys that are not used: %s", file, ", ".join(unused))
    own = [{key: value for key, value in entry.items() if value is not None} for entry in entries]
    return [Frame(f"{file}: frames[{i}]", {**content, **own[i]}, c2w[i]) for i in range(len(entries))]


def parse_matrix(where: object, key: str, value: Any) -> Float[np.ndarray, "4 4"]:
    """A matrix of 3 or 4 rows of 4 numbers; the fourth row is 0 0 0 1 if absent."""
    matrix = checks.parse_floats(where, key, value)
    if matrix.shape not in ((4, 4), (3, 4)):
        raise InputError(where, key, f"shape {matrix.shape}", "4 rows of 4 numbers")
    return np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])[:4]


def undo_applied(file: Path, content: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Similarity from the file's world frame back to that of the capture.

    nerfstudio turns the capture by `applied_transform` and then scales it by `applied_scale`; exports have its place and unit.
    """
    applied = parse_matrix(file, "applied_transform", content.get("applied_transform", np.eye(4)))
    applied[:3] *= checks.parse_number(file, "applied_scale", content.get("applied_scale", 1.0))
    return np.linalg.inv(checks.check_similarity(file, "applied_transform, applied_scale", applied))


def read_size(frame: Frame) -> tuple[int, int] | None:
    """Width and height in pixels that a file states for a camera, None where it states none."""
    width, height = frame.number("w"), frame.number("h")
    if width is None or height is None:
        return None
    if min(width, height) < 1:
        raise InputError(frame.where, "w, h", f"{width:g}x{height:g}", "the pixels of a photo")
    return round(width), round(height)


def read_optics(frame: Frame, width: int, height: int) -> Intrinsics:
    """Intrinsics of one frame for photos of a size, in pixels of that size."""
    values = frame.values
    model = values.get("camera_model") or "OPENCV"
    if model == EQUIRECTANGULAR:
        if abs(width - 2 * height) > 2:
            found, expected = f"{model} of {width}x{height} pixels", "photos twice as wide as high, of all directions"
            raise InputError(frame.where, "camera_model", found, expected)
        return equirectangular(width, height)
    if model not in (*PERSPECTIVE, *FISHEYE):
        expected = f"one of {', '.join((*PERSPECTIVE, *FISHEYE, EQUIRECTANGULAR))}"
        raise InputError(frame.where, "camera_model", repr(model)[:60], expected)
    fisheye = model in FISHEYE or bool(values.get("is_fisheye"))
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    for key in REFUSED if fisheye else (*REFUSED, "k4"):
        value = values.get(key)
        if any(value) if isinstance(value, list) else value not in (None, False, 0, "0"):
            expected = f"at most {', '.join(names)}"
            raise InputError(frame.where, key, repr(value)[:60], expected, "calibrate or export with these alone")
    found_x, found_y = read_focal(frame, "x", width, fisheye), read_focal(frame, "y", height, fisheye)
    fx, fy = found_x or found_y, found_y or found_x
    if fx is None or fy is None:
        found = f"no focal length among [{', '.join(sorted(values))}]"
        raise InputError(frame.where, "fl_x", found, "fl_x in pixels or camera_angle_x in radians")
    cx, cy = frame.number("cx"), frame.number("cy")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    distortion = Distortion(**{key: frame.number(key) or 0.0 for key in names})
    projection = Projection.FISHEYE if fisheye else Projection.PERSPECTIVE
    return checks.check_optics(frame.where, "", Intrinsics(width, height, fx, fy, cx, cy, distortion, projection))


def read_focal(frame: Frame, axis: str, side: int, fisheye: bool) -> float | None:
    """Focal length along an axis in pixels: `fl_x` first, then `camera_angle_x` in radians, then `x_fov` in degrees."""
    given, angle, degrees = (frame.number(key) for key in (f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"))
    if given is not None:
        return given
    if angle is None and degrees is not None:
        angle = math.radians(degrees)
    if angle is None:
        return None
    if not MIN_ANGLE < angle < math.pi:
        raise InputError(frame.where, f"camera_angle_{axis}", f"{angle:g}", "radians, between 0 and pi")
    return side / (angle if fisheye else 2 * math.tan(0.5 * angle))
