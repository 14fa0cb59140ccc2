"""Camera path files of this package, nerfstudio and instant-ngp."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerf_lightning.cameras import Cameras, transform_poses
from nerf_lightning.dataset.formats.transforms_json import opengl_to_opencv
from nerf_lightning.errors import InputError
from nerf_lightning.runs.scene_file import parse_cameras
from nerf_lightning.utils.parsing import read_json

NGP_SCALE, NGP_OFFSET = 0.33, 0.5
"""instant-ngp's defaults: its world is scale * x + offset with cycled axes (nerf_loader.h)."""
NGP_AXES = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""Permutation from its axes (y, z, x) to the file's."""


def read_path(file: Path, orbit: Cameras, to_source: Float[Tensor, "4 4"], frame: str = "auto") -> Cameras:
    """Reads a camera path from a JSON file and transforms it to the run's frame; prints the assumed frame.

    Formats: this package's (`width`, `height`, `K` 3x3 or a list of them in pixels, `c2w` a list of 4x4 in the OpenCV frame,
    as `orbit` in a run's scene.json); nerfstudio's (`render_width`, `render_height`, `camera_path` with `camera_to_world` in
    the OpenGL frame and the vertical `fov` in degrees); instant-ngp's (`path` with quaternions `R` as x, y, z, w, positions
    `T` in its own frame and unit, and the vertical `fov` in degrees).

    Args:
        file: JSON.
        orbit: the run's; its size is the default.
        to_source: similarity from the run's frame to the dataset's.
        frame: "run", "file" (the dataset's), or "auto": run for this package's format, file for others.

    Raises:
        InputError: another format, or damaged.
    """
    plain = read_json(file, "a camera path in JSON")
    try:
        if "camera_path" in plain:
            plain, kind, native = _parse_nerfstudio(plain), "nerfstudio's path", "file"
        elif "path" in plain:
            kind, native = "instant-ngp's path, of scale 0.33 and offset 0.5", "file"
            plain = _parse_instant_ngp(plain, *orbit.size(0))
        else:
            kind, native = "a path", "run"
        cameras = parse_cameras(file, "", plain)
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        expected = "give width, height, K and c2w, or nerfstudio's camera_path, or instant-ngp's path"
        raise InputError(file, "", f"no camera path ({type(error).__name__}: {error})", hint=expected) from error
    source_frame = native if frame == "auto" else frame
    where = "the run's frame" if source_frame == "run" else "the world frame of the photos' own file"
    print(f"{file}: {kind} in {where} (--path-frame {'file' if source_frame == 'run' else 'run'} takes the other)")
    if source_frame == "run":
        return cameras
    in_run = transform_poses(cameras.c2w, torch.linalg.inv(to_source.double()))
    return replace(cameras, c2w=in_run.to(cameras.c2w))


def _parse_nerfstudio(plain: dict[str, Any]) -> dict[str, Any]:
    views, size = plain["camera_path"], (int(plain["render_width"]), int(plain["render_height"]))
    poses = np.array([view["camera_to_world"] for view in views], np.float64).reshape(-1, 4, 4)
    return _make_cameras_from_fov(views, opengl_to_opencv(poses), *size)


def _parse_instant_ngp(plain: dict[str, Any], width: int, height: int) -> dict[str, Any]:
    """Its cameras are OpenCV cameras, as ours."""
    poses = np.tile(np.eye(4), (len(plain["path"]), 1, 1))
    for pose, view in zip(poses, plain["path"], strict=True):
        pose[:3, :3] = Rotation.from_quat(np.array(view["R"], np.float64)).as_matrix()
        pose[:3, 3] = (np.array(view["T"], np.float64) - NGP_OFFSET) / NGP_SCALE
    return _make_cameras_from_fov(plain["path"], NGP_AXES @ poses, width, height)


def _make_cameras_from_fov(views: list[dict[str, Any]], c2w: Any, width: int, height: int) -> dict[str, Any]:
    """Cameras as plain values, from vertical fields of view in degrees."""
    focal = [height / (2 * math.tan(math.radians(float(view["fov"])) / 2)) for view in views]
    K = [[[f, 0, width / 2], [0, f, height / 2], [0, 0, 1]] for f in focal]
    return {"width": width, "height": height, "K": K, "c2w": c2w}
