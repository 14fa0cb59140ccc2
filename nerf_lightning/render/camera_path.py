"""Camera paths of videos: orbit, spiral, photos or a file."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Cameras, make_spiral_path, resample_path
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.errors import InputError
from nerf_lightning.render.path_file import read_path
from nerf_lightning.utils.files import expand_user_path
from nerf_lightning.utils.text import subsample

PHOTO_PATHS = {"test": "val", "train": "train"}
"""Paths along photos, and their split of a scene."""
SPIRAL_FRAMES = 120


@dataclass(frozen=True)
class CameraPath:
    """Cameras of a video's frames, in order."""

    cameras: Cameras
    views: list[int]
    """Indices among the photos, or among the path's views."""
    photos: Views | None = None
    """Ground truth of the views, if known."""


def build_path(
    path: str,
    frames: int | None,
    orbit: Cameras,
    scene: Scene | None,
    to_source: Float[Tensor, "4 4"],
    path_frame: str = "auto",
    scale: float = 1.0,
) -> CameraPath:
    """Builds a camera path from a name or a file.

    Args:
        path: "orbit", "spiral", "test" (held-out photos), "train" (training photos), or a JSON file.
        frames: number of frames; None takes the path's.
        orbit: the run's.
        scene: with photos, for "test" and "train".
        to_source: similarity from the run's frame to the dataset's.
        path_frame: of a file, see `read_path`.
        scale: factor on the width and height; 1 for photos.

    Raises:
        InputError: an unknown name, or an invalid file.
    """
    if scene is not None:
        if scale != 1:
            raise InputError("render", "scale", f"{scale:g}", f"1 for photos (path {path})")
        photos: Views = getattr(scene, PHOTO_PATHS[path])
        chosen = subsample(len(photos), frames)
        index = torch.tensor(chosen)
        return CameraPath(photos.cameras[index], chosen, photos[index])
    if path == "orbit":
        cameras = resample_path(orbit, frames or len(orbit), closed=True)
    elif path == "spiral":
        cameras = make_spiral_path(orbit, frames or SPIRAL_FRAMES)
    elif path.endswith(".json"):
        cameras = read_path(expand_user_path(path), orbit, to_source, path_frame)
        cameras = resample_path(cameras, frames or len(cameras), closed=False)
    else:
        expected = f"one of orbit, spiral, {', '.join(PHOTO_PATHS)}, or a .json file"
        raise InputError("render", "path", repr(path), expected)
    return CameraPath(cameras if scale == 1 else cameras.rescale(scale), list(range(len(cameras))))
