"""scene.json of a run: what rendering needs to know about the scene, without its photos."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.config.build import Frame, PictureFrame, SceneFrame, frame_of
from nerf_lightning.dataset import BUILT_IN, PixelDataModule, RayDataModule, Scene
from nerf_lightning.dataset.formats import checks
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.parsing import read_json

PICTURE = ("name", "resolution")
SCENE = ("name", "aabb", "unbounded", "near", "far", "background", "orbit", "to_source")
"""Keys of every scene.json, of a picture and of a scene."""


def save_scene(
    data: RayDataModule | PixelDataModule,
    folder: Path,
    corrected: Cameras | None = None,
    focal_factor: float | None = None,
) -> None:
    """Writes what rendering needs of the scene, without its photos, and the training cameras if training has corrected them,
    perhaps with a factor on their focal length."""
    content = scene_content(data)
    if corrected is not None:
        content |= {"corrected": corrected.c2w.tolist(), "focal_factor": focal_factor}
    write_json(folder / "scene.json", content)


def scene_content(data: RayDataModule | PixelDataModule) -> dict[str, Any]:
    """The same as plain values."""
    scene, frame = data.scene, frame_of(data)
    content: dict[str, Any] = {**scene.describe()}
    if scene.source != BUILT_IN:
        content["source"] = os.path.abspath(scene.source)
    if isinstance(scene, Scene) and isinstance(frame, SceneFrame):
        content |= {
            # Of any photo: `resize=auto` chooses by the budget, device and memory, which differ when the run is opened again.
            "longest": max(views.cameras.longest for views in (scene.train, scene.val)),
            "background": list(frame.background),
            "aabb": frame.bounds.aabb.tolist(),
            "unbounded": frame.bounds.unbounded,
            "near": frame.bounds.near,
            "far": frame.bounds.far,
            "pixel": frame.bounds.pixel,
            "to_source": scene.to_source.tolist(),
            "orbit": {
                "K": scene.orbit.K.tolist(),
                "c2w": scene.orbit.c2w.tolist(),
                "width": scene.orbit.width,
                "height": scene.orbit.height,
            },
        }
    return content


def load_scene(folder: Path) -> dict[str, Any]:
    """The content of a run's scene.json, whose values `frame_from` checks.

    Raises:
        InputError: where it is missing or broken.
    """
    path = folder / "scene.json"
    scene = read_json(path, "the scene of a run, whole", "")
    if not isinstance(scene, dict):
        raise InputError(path, "", f"a {type(scene).__name__}", "the scene of a run, whole")
    return scene


def frame_from(scene: Mapping[str, Any], where: object) -> tuple[Frame, Cameras | None, Tensor | None]:
    """Reads what `scene_content` gave: a system's frame, the orbit, and the transform to the source; None for a picture.

    Args:
        scene: read back from a file.
        where: that file, for messages.

    Raises:
        InputError: where a value is missing or cannot be.
    """
    checks.require_keys(where, scene, SCENE if "aabb" in scene else PICTURE)
    for key in ("name", "source"):
        if not isinstance(scene.get(key, ""), str):
            raise InputError(where, key, repr(scene[key]), "text")
    if "aabb" not in scene:
        return PictureFrame(*_size(where, "resolution", scene["resolution"])), None, None
    near, far, pixel = (_number_or_none(where, key, scene.get(key)) for key in ("near", "far", "pixel"))
    checks.near_far(where, near, far)
    if not isinstance(scene["unbounded"], bool):
        raise InputError(where, "unbounded", repr(scene["unbounded"]), "true or false")
    if pixel is not None:
        checks.positive(where, "pixel", pixel, "world units")
    aabb = torch.from_numpy(checks.box(where, "aabb", numbers(where, "aabb", scene["aabb"]))).float()
    colour = checks.numeric(where, "background", numbers(where, "background", scene["background"]), "3")
    red, green, blue = colour.tolist()
    to_source = checks.similarity(where, "to_source", numbers(where, "to_source", scene["to_source"]))
    frame = SceneFrame(Bounds(aabb, scene["unbounded"], near, far, pixel), (red, green, blue))
    return frame, _orbit(where, scene["orbit"]), torch.from_numpy(to_source)


def numbers(where: object, key: str, value: Any) -> Float[np.ndarray, "..."]:
    """Lists of numbers as an array.

    Raises:
        InputError: where they hold anything else, or rows of several lengths.
    """
    try:
        return np.array(value, dtype=np.float64)
    except (ArithmeticError, TypeError, ValueError) as error:
        raise InputError(where, key, repr(value)[:60], "numbers, in rows of one length") from error


def _orbit(where: object, view: Any) -> Cameras:
    if not isinstance(view, dict):
        raise InputError(where, "orbit", repr(view), "K, c2w, width and height")
    checks.require_keys(f"{where}: orbit", view, ("K", "c2w", "width", "height"))
    width, height = _size(where, "orbit", [view["width"], view["height"]])
    c2w = checks.rigid_poses(where, "orbit.c2w[{}]", numbers(where, "orbit.c2w", view["c2w"]))
    K = numbers(where, "orbit.K", view["K"])
    if K.shape != (len(c2w), 3, 3) or not len(c2w):
        raise InputError(where, "orbit.K", f"shape {K.shape}", f"shape ({len(c2w)}, 3, 3), of at least one view")
    K = np.stack([checks.intrinsics(where, f"orbit.K[{number}]", one, width, height) for number, one in enumerate(K)])
    return Cameras.of_size(torch.from_numpy(K).float(), torch.from_numpy(c2w).float(), width, height)


def _size(where: object, key: str, value: Any) -> tuple[int, int]:
    if not isinstance(value, list) or len(value) != 2:
        raise InputError(where, key, repr(value), "a width and a height")
    return checks.view_size(where, key, *value)


def _number_or_none(where: object, key: str, value: Any) -> float | None:
    return None if value is None else checks.number(where, key, value)
