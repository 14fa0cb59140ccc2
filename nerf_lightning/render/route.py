"""Routes: which views a film shows."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp

from nerf_lightning.cameras import Cameras, spiral_like
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.dataset.formats import checks
from nerf_lightning.errors import InputError
from nerf_lightning.utils.evenly import evenly
from nerf_lightning.utils.files import user_path
from nerf_lightning.utils.untrusted import read_json

WORDS = ("orbit", "spiral", "test", "train")
WITH_PHOTOS = {"test": "val", "train": "train"}
SPIRAL_FRAMES = 120
OPENGL_TO_OPENCV = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


@dataclass(frozen=True)
class Route:
    """Views in the order in which they are shown."""

    cameras: Cameras
    views: list[int]
    """Their numbers among the photos, for captions; without photos, among the path's views."""
    photos: Views | None = None
    """What the views should show, where that is known."""


def find_route(path: str, frames: int | None, orbit: Cameras, scene: Scene | None) -> Route:
    """The views that a name or a file stands for.

    Args:
        path: "orbit", "spiral", "test" (held-out photos), "train" (training photos), or a JSON file.
        frames: how many; None takes as many as there are.
        orbit: the run's.
        scene: with photos, for "test" and "train".

    Raises:
        InputError: for another word, or a file that is no camera path.
    """
    if path in WITH_PHOTOS:
        assert scene is not None  # the caller opens it for these words
        photos: Views = getattr(scene, WITH_PHOTOS[path])
        chosen = evenly(len(photos), frames)
        index = torch.tensor(chosen)
        return Route(photos.cameras[index], chosen, photos[index])
    if path == "orbit":
        cameras = along(orbit, len(orbit) if frames is None else frames, closed=True)
    elif path == "spiral":
        cameras = spiral_like(orbit, SPIRAL_FRAMES if frames is None else frames)
    elif path.endswith(".json"):
        cameras = read_path(user_path(path))
        cameras = along(cameras, len(cameras) if frames is None else frames, closed=False)
    else:
        raise InputError("config", "path", repr(path), f"one of {', '.join(WORDS)}, or a .json file")
    return Route(cameras, list(range(len(cameras))))


def along(cameras: Cameras, frames: int, closed: bool) -> Cameras:
    """As many views as asked for along a path: some of its own, or more between them.

    Args:
        cameras: the path.
        frames: how many.
        closed: whether the path goes on from its last view to its first.
    """
    count = len(cameras)
    if frames <= count or count < 2:
        return cameras[torch.tensor(evenly(count, frames))]
    at = np.arange(frames) * (count / frames) if closed else np.linspace(0, count - 1, frames)
    loop = torch.arange(count + closed) % count
    c2w = cameras.c2w[loop].double().numpy()
    turned = Slerp(np.arange(len(loop)), Rotation.from_matrix(c2w[:, :3, :3]))(at).as_matrix()
    moved = np.stack([np.interp(at, np.arange(len(loop)), c2w[:, i, 3]) for i in range(3)], axis=-1)
    poses = torch.eye(4).repeat(frames, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turned)
    poses[:, :3, 3] = torch.from_numpy(moved)
    below = torch.from_numpy(at.astype(int))
    part = torch.from_numpy(at - at.astype(int)).float()[:, None, None]
    K = cameras.K[loop]
    after = (below + 1).clamp_max(len(loop) - 1)
    return Cameras.of_size(K[below] * (1 - part) + K[after] * part, poses, cameras.width, cameras.height)


def read_path(file: Path) -> Cameras:
    """A camera path from a JSON file, in the frame of the run.

    Either of this package's kind (`width`, `height`, `K` 3x3 or a list of them in pixels, `c2w` a list of 4x4 in the OpenCV
    frame, as `orbit` in a run's scene.json), or of nerfstudio's (`render_width`, `render_height`, `camera_path` with
    `camera_to_world` in the OpenGL frame and the vertical `fov` in degrees).

    Raises:
        InputError: where it is neither.
    """
    plain = read_json(file, "a camera path in JSON")
    try:
        cameras = _nerfstudio(plain) if "camera_path" in plain else _own(plain)
    except (ArithmeticError, ValueError, KeyError, TypeError, RuntimeError, AttributeError) as error:
        found = f"no {error}" if isinstance(error, KeyError) else str(error)
        raise InputError(file, "", found, "width, height, K and c2w, or nerfstudio's camera_path") from error
    if not len(cameras) or min(cameras.width, cameras.height) < 1:
        found = f"{len(cameras)} views of {cameras.width} x {cameras.height}"
        raise InputError(file, "", found, "at least one view of one pixel")
    checks.view_size(file, "", cameras.width, cameras.height)
    R = cameras.c2w[:, :3, :3]
    if not (torch.isfinite(cameras.c2w).all() and torch.isfinite(cameras.K).all()):
        raise InputError(file, "", "numbers that are not finite", "finite poses and intrinsics")
    for K in cameras.K.unique(dim=0):
        checks.intrinsics(file, "K or fov", K.numpy(), cameras.width, cameras.height)
    if not torch.allclose(R @ R.mT, torch.eye(3).expand_as(R), atol=1e-3):
        raise InputError(file, "", "a pose that is no rotation", "orthonormal rotations, without scale")
    return cameras


def _own(plain: dict[str, Any]) -> Cameras:
    c2w = torch.tensor(plain["c2w"], dtype=torch.float32).view(-1, 4, 4)
    K = torch.tensor(plain["K"], dtype=torch.float32).view(-1, 3, 3).expand(len(c2w), 3, 3)
    return Cameras.of_size(K.contiguous(), c2w, int(plain["width"]), int(plain["height"]))


def _nerfstudio(plain: dict[str, Any]) -> Cameras:
    width, height = int(plain["render_width"]), int(plain["render_height"])
    poses, K = [], []
    for view in plain["camera_path"]:
        poses.append(torch.tensor(view["camera_to_world"], dtype=torch.float32).view(4, 4) @ OPENGL_TO_OPENCV)
        focal = height / (2 * math.tan(math.radians(float(view["fov"])) / 2))
        K.append(torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]))
    return Cameras.of_size(torch.stack(K), torch.stack(poses), width, height)
