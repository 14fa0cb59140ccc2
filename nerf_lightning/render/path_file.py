"""Camera paths from files: this package's, nerfstudio's and instant-ngp's."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerf_lightning.cameras import Cameras, in_other_frame
from nerf_lightning.dataset.formats import checks
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_json

OPENGL_TO_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
NGP_SCALE, NGP_OFFSET = 0.33, 0.5
"""instant-ngp's world is scale * x + offset with axes cycled (nerf_loader.h); a path does not say if a scene sets others."""
NGP_AXES = torch.tensor([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From its axes (y, z, x) to the file's."""


def read_path(file: Path, orbit: Cameras, to_source: Float[Tensor, "4 4"], frame: str = "auto") -> Cameras:
    """A camera path from a JSON file, moved to the run's frame; prints in which frame it was taken to be.

    Either of this package's kind (`width`, `height`, `K` 3x3 or a list of them in pixels, `c2w` a list of 4x4 in the OpenCV
    frame, as `orbit` in a run's scene.json), of nerfstudio's (`render_width`, `render_height`, `camera_path` with
    `camera_to_world` in the OpenGL frame and the vertical `fov` in degrees), or of instant-ngp's (`path` with quaternions `R`
    of x, y, z, w, places `T` in its own frame and unit, and the vertical `fov` in degrees).

    Args:
        file: JSON.
        orbit: of the run; its size is that of a path that states none.
        to_source: from the run's frame to that of the photos' own file.
        frame: "run", "file", or "auto": this package's paths are in the run's, others in the file's.

    Raises:
        InputError: where it is none of these.
    """
    plain = read_json(file, "a camera path in JSON")
    try:
        if "camera_path" in plain:
            cameras, kind, own = _nerfstudio(plain), "nerfstudio's path", "file"
        elif "path" in plain:
            cameras, kind, own = (
                _instant_ngp(plain, *orbit.size(0)),
                "instant-ngp's path, of scale 0.33 and offset 0.5",
                "file",
            )
        else:
            cameras, kind, own = _own(plain), "a path", "run"
    except (ArithmeticError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        found = f"no {error}" if isinstance(error, KeyError) else str(error)
        expected = "width, height, K and c2w, or nerfstudio's camera_path, or instant-ngp's path"
        raise InputError(file, "", found, expected) from error
    _check(file, cameras)
    taken = own if frame == "auto" else frame
    where = "the run's frame" if taken == "run" else "the world frame of the photos' own file"
    print(f"{file}: {kind} in {where} (--path-frame {'file' if taken == 'run' else 'run'} takes the other)")
    if taken == "run":
        return cameras
    moved = in_other_frame(cameras.c2w, torch.linalg.inv(to_source.double()))
    return replace(cameras, c2w=moved.to(cameras.c2w))


def _check(file: Path, cameras: Cameras) -> None:
    if not len(cameras) or min(cameras.width, cameras.height) < 1:
        found = f"{len(cameras)} views of {cameras.width} x {cameras.height}"
        raise InputError(file, "", found, "at least one view of one pixel")
    checks.check_view_size(file, "", cameras.width, cameras.height)
    R = cameras.c2w[:, :3, :3]
    if not (torch.isfinite(cameras.c2w).all() and torch.isfinite(cameras.K).all()):
        raise InputError(file, "", "numbers that are not finite", "finite poses and intrinsics")
    for K in cameras.K.unique(dim=0):
        checks.check_intrinsics(file, "K or fov", K.numpy(), cameras.width, cameras.height)
    if not torch.allclose(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-3) or bool((torch.linalg.det(R) < 0).any()):
        raise InputError(file, "", "a pose that is no rotation", "orthonormal rotations, without scale or mirroring")


def _own(plain: dict[str, Any]) -> Cameras:
    c2w = torch.tensor(plain["c2w"], dtype=torch.float32).view(-1, 4, 4)
    K = torch.tensor(plain["K"], dtype=torch.float32).view(-1, 3, 3).expand(len(c2w), 3, 3)
    return Cameras.of_size(K.contiguous(), c2w, int(plain["width"]), int(plain["height"]))


def _nerfstudio(plain: dict[str, Any]) -> Cameras:
    width, height = int(plain["render_width"]), int(plain["render_height"])
    poses = [
        torch.tensor(view["camera_to_world"], dtype=torch.float32).view(4, 4) @ OPENGL_TO_OPENCV
        for view in plain["camera_path"]
    ]
    K = [_vertical_fov(float(view["fov"]), width, height) for view in plain["camera_path"]]
    return Cameras.of_size(torch.stack(K), torch.stack(poses), width, height)


def _instant_ngp(plain: dict[str, Any], width: int, height: int) -> Cameras:
    """Its cameras look along z with y down, as ours do."""
    poses = torch.eye(4, dtype=torch.float64).repeat(len(plain["path"]), 1, 1)
    for pose, view in zip(poses, plain["path"], strict=True):
        pose[:3, :3] = torch.from_numpy(Rotation.from_quat(np.array(view["R"], np.float64)).as_matrix())
        pose[:3, 3] = (torch.tensor(view["T"], dtype=torch.float64) - NGP_OFFSET) / NGP_SCALE
    K = [_vertical_fov(float(view["fov"]), width, height) for view in plain["path"]]
    return Cameras.of_size(torch.stack(K), (NGP_AXES.double() @ poses).float(), width, height)


def _vertical_fov(degrees: float, width: int, height: int) -> Float[Tensor, "3 3"]:
    """Intrinsics of a vertical field of view."""
    focal = height / (2 * math.tan(math.radians(degrees) / 2))
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
