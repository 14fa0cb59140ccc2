"""scene.json: what rendering a run needs to know of its scene, without photos."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.config.build import ImageMetadata, Metadata, SceneMetadata, get_metadata
from nerf_lightning.dataset import BUILT_IN, DataModule
from nerf_lightning.dataset.formats import checks
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.parsing import read_json

EXPECTED_CONTENT = "the scene of a run, whole"


def save_scene(
    data: DataModule, folder: Path, corrected: Cameras | None = None, focal_factor: float | None = None
) -> None:
    """Writes scene.json, with refined training cameras and the factor on their focal length, if any."""
    content = scene_to_dict(data)
    if corrected is not None:
        content |= {"corrected": corrected.c2w.tolist(), "focal_factor": focal_factor}
    write_json(folder / "scene.json", content)


def scene_to_dict(data: DataModule) -> dict[str, Any]:
    """The content of scene.json as plain values."""
    scene, frame = data.scene, get_metadata(data)
    content: dict[str, Any] = dict(scene.describe())
    if scene.source != BUILT_IN:
        content["source"] = os.path.abspath(scene.source)
    if isinstance(frame, SceneMetadata):
        content |= {
            # `resize=auto` depends on budget, device and memory, which may differ when the run is reopened.
            "longest": max(views.cameras.max_side for views in (scene.train, scene.val)),
            "background": list(frame.background),
            "aabb": frame.bounds.aabb.tolist(),
            "unbounded": frame.bounds.unbounded,
            "core": None if frame.bounds.core is None else frame.bounds.core.tolist(),
            "near": frame.bounds.near,
            "far": frame.bounds.far,
            "pixel": frame.bounds.pixel_footprint,
            "to_source": scene.to_source.tolist(),
            "orbit": {
                "K": scene.orbit.K.tolist(),
                "c2w": scene.orbit.c2w.tolist(),
                "width": scene.orbit.width,
                "height": scene.orbit.height,
            },
        }
    return content


def read_scene_file(folder: Path) -> dict[str, Any]:
    """Reads scene.json; `parse_metadata` checks its values.

    Raises:
        InputError: the file is missing or damaged.
    """
    path = folder / "scene.json"
    scene = read_json(path, EXPECTED_CONTENT, "")
    if not isinstance(scene, dict):
        raise InputError(path, "", f"a {type(scene).__name__}", EXPECTED_CONTENT)
    return scene


def parse_metadata(scene: Mapping[str, Any], where: object) -> tuple[Metadata, Cameras | None, Tensor | None]:
    """Parses scene.json: a system's metadata, the orbit, and the transform to the dataset's frame; both None for an image.

    Args:
        scene: content of the file.
        where: the file, for messages.

    Raises:
        InputError: a value is missing or invalid.
    """
    try:
        if "aabb" not in scene:
            return ImageMetadata(*checks.check_view_size(where, "resolution", *scene["resolution"])), None, None
        limits = {key: scene[key] for key in ("near", "far", "pixel")}
        near, far, pixel = (None if x is None else checks.parse_number(where, key, x) for key, x in limits.items())
        checks.check_near_far(where, near, far)
        aabb = torch.from_numpy(checks.check_box(where, "aabb", scene["aabb"])).float()
        red, green, blue = checks.parse_array(where, "background", scene["background"], 3).tolist()
        to_source = checks.check_similarity(where, "to_source", scene["to_source"])
        core = scene.get("core")  # absent from older runs
        core = None if core is None else torch.from_numpy(checks.check_box(where, "core", core)).float()
        frame = SceneMetadata(Bounds(aabb, bool(scene["unbounded"]), near, far, pixel, core), (red, green, blue))
        return frame, parse_cameras(where, "orbit.", scene["orbit"]), torch.from_numpy(to_source)
    except (LookupError, TypeError) as error:
        raise InputError(where, "", f"damaged ({type(error).__name__}: {error})") from error


def parse_cameras(where: object, key: str, views: Mapping[str, Any]) -> Cameras:
    """Cameras from plain values: `width`, `height`, `K` (shared or per view, pixels) and `c2w` (OpenCV frame).

    Raises:
        InputError: invalid poses or intrinsics, or no view.
        LookupError: for a missing key.
    """
    width, height = checks.check_view_size(where, key, views["width"], views["height"])
    c2w = checks.check_poses(where, f"{key}c2w[{{}}]", views["c2w"])
    K = checks.parse_floats(where, f"{key}K", views["K"])
    if not len(c2w) or K.shape not in ((3, 3), (len(c2w), 3, 3)):
        found = f"shape {K.shape} for {len(c2w)} views"
        raise InputError(where, f"{key}K", found, "shape (V, 3, 3) with at least one view")
    matrices = np.broadcast_to(K, (len(c2w), 3, 3))
    K = np.stack([checks.check_intrinsics(where, f"{key}K", matrix, width, height) for matrix in matrices])
    return Cameras.pinhole(torch.from_numpy(K).float(), torch.from_numpy(c2w).float(), width, height)
