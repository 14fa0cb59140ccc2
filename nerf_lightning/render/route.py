"""Routes: which views a film shows."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Cameras, resample_path, spiral_like
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.errors import InputError
from nerf_lightning.render.path_file import FRAMES, read_path
from nerf_lightning.utils.files import user_path
from nerf_lightning.utils.text import subsample

WORDS = ("orbit", "spiral", "test", "train")
WITH_PHOTOS = {"test": "val", "train": "train"}
SPIRAL_FRAMES = 120


@dataclass(frozen=True)
class Route:
    """Views in the order in which they are shown."""

    cameras: Cameras
    views: list[int]
    """Their numbers among the photos, for captions; without photos, among the path's views."""
    photos: Views | None = None
    """What the views should show, where that is known."""


def find_route(
    path: str,
    frames: int | None,
    orbit: Cameras,
    scene: Scene | None,
    to_source: Float[Tensor, "4 4"] | None = None,
    frame: str = "auto",
) -> Route:
    """The views that a name or a file stands for.

    Args:
        path: "orbit", "spiral", "test" (held-out photos), "train" (training photos), or a JSON file.
        frames: how many; None takes as many as there are.
        orbit: the run's.
        scene: with photos, for "test" and "train".
        to_source: from the run's frame to that of the photos' own file; None where they are the same.
        frame: of a file, see `read_path`.

    Raises:
        InputError: for another word, or a file that is no camera path.
    """
    if frame not in FRAMES:
        raise InputError("config", "path_frame", repr(frame), f"one of {', '.join(FRAMES)}")
    if frame != "auto" and not path.endswith(".json"):
        raise InputError(
            "config", "path_frame", f"{frame!r} with path={path}", "auto; it is for a .json file of your own"
        )
    if path in WITH_PHOTOS:
        assert scene is not None  # the caller opens it for these words
        photos: Views = getattr(scene, WITH_PHOTOS[path])
        chosen = subsample(len(photos), frames)
        index = torch.tensor(chosen)
        return Route(photos.cameras[index], chosen, photos[index])
    if path == "orbit":
        cameras = resample_path(orbit, len(orbit) if frames is None else frames, closed=True)
    elif path == "spiral":
        cameras = spiral_like(orbit, SPIRAL_FRAMES if frames is None else frames)
    elif path.endswith(".json"):
        cameras = read_path(user_path(path), orbit, torch.eye(4) if to_source is None else to_source, frame)
        cameras = resample_path(cameras, len(cameras) if frames is None else frames, closed=False)
    else:
        raise InputError("config", "path", repr(path), f"one of {', '.join(WORDS)}, or a .json file")
    return Route(cameras, list(range(len(cameras))))
