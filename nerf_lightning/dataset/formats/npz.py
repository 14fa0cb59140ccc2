"""The course format: one .npz file with images, OpenCV camera-to-world poses and a focal length."""

import logging
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.posed import Hints, assemble_scene, split_shots
from nerf_lightning.dataset.resize import area_resize, choose_resize, fit_size
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, PhotoLoadOptions
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.parsing import read_npz

log = logging.getLogger(__name__)

NEEDED = ("images_train", "c2ws_train")
PAIRS = {"images_train": "c2ws_train", "images_val": "c2ws_val", "images_test": "c2ws_test"}
"""Images of each split, and their poses."""
OTHERS = ("focal", "K", "near", "far", "aabb", "background", "unbounded", "to_source")


def load_npz(path: Path, name: str | None = None, options: PhotoLoadOptions = AS_IT_IS) -> Scene:
    """Reads the course format. Poses are OpenCV camera to world already: nothing is converted.

    Entries, with V views a split:
        images_train, images_val, images_test: (V, H, W, 3 or 4), uint8 or floats in [0, 1]; without val, test is held out, or
            every `options.holdout`-th of train.
        c2ws_train, c2ws_val, c2ws_test: (V, 4, 4); the last without images is the orbit, made up like the training cameras if
            absent.
        focal: pixels, with the principal point in the middle; or K: (3, 3), for all views, which then rules.
        near, far: distances along the rays, and aabb: (2, 3), world units, with unbounded: whether content lies outside aabb
            too; without aabb the photos decide, see `decide_kind`.
        background: (3,), sRGB; if absent the one colour along the photos' borders, or black.
        to_source: (4, 4), similarity to the frame of the original, identity if absent.

    Raises:
        InputError: anything missing, malformed or contradictory.
    """
    data = read_npz(path, (*PAIRS, *PAIRS.values(), *OTHERS))
    _check_shapes(path, data)
    count, height, width, channels = data["images_train"].shape
    size = fit_size(width, height, choose_resize(path, [(width, height)] * count, channels, options.resize))
    K = _intrinsics(path, data, width, height)

    def read_poses(key: str) -> Cameras:
        c2w = checks.check_poses(path, key + "[{}]", data[key])
        checks.check_split_size(path, key, len(c2w))
        return Cameras.of_size(K.repeat(len(c2w), 1, 1), torch.from_numpy(c2w), width, height).resized(size)

    def read_views(key: str) -> Views:
        images = _bytes(path, key, data[key])
        images = images if size == (width, height) else np.stack([area_resize(image, *size) for image in images])
        return Views.of(torch.from_numpy(images), read_poses(PAIRS[key]))

    train, *held_out = (read_views(key) for key in PAIRS if key in data)
    if not held_out:
        log.warning("%s: no held-out photos: every %d-th training photo is held out", path, options.holdout)
        split = split_shots(path, len(train), options.holdout)
        train, val = (train[torch.tensor(part)] for part in (split.train, split.val))
        held_out = [val]
    near, far = (checks.parse_number(path, key, data[key]) if key in data else None for key in ("near", "far"))
    checks.check_near_far(path, near, far)
    has_path = "c2ws_test" in data and "images_test" not in data
    hints = Hints(
        keep_frame=True,
        path=read_poses("c2ws_test") if has_path else None,
        background=_background(path, data["background"]) if "background" in data else None,
        bounds=_bounds(path, data, options),
        to_source=checks.check_similarity(path, "to_source", data["to_source"]) if "to_source" in data else None,
        near=near,
        far=far,
    )
    name = name or re.sub(r"_\d+x\d+$", "", path.stem)
    return assemble_scene(path, name, [train, *held_out], options, hints)


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    checks.require_keys(path, arrays, NEEDED)
    one = arrays["images_train"].shape[1:]
    for key in (key for key in PAIRS if key in arrays):
        checks.require_keys(path, arrays, [PAIRS[key]])
        (count, *shape), dtype = arrays[key].shape or (0,), arrays[key].dtype
        if len(shape) != 3 or shape[2] not in (3, 4) or 0 in shape or (dtype != np.uint8 and dtype.kind != "f"):
            expected = "images of shape (V, H, W, 3 or 4), uint8 or floats in [0, 1]"
            raise InputError(path, key, f"shape {arrays[key].shape}, {dtype}", expected)
        if tuple(shape) != one:
            raise InputError(path, key, f"shape {arrays[key].shape}", f"images of shape {one}, as in images_train")
        checks.check_split_size(path, key, count)
        if (poses := arrays[PAIRS[key]].shape[:1]) != (count,):
            raise InputError(path, key, f"{count} images for {math.prod(poses)} poses", "one pose for each image")


def _bytes(path: Path, key: str, images: Shaped[np.ndarray, "V H W C"]) -> UInt8[np.ndarray, "V H W C"]:
    """Images as uint8; floats in [0, 1] are scaled and rounded."""
    if images.dtype == np.uint8:
        return images
    if not (images.min() >= 0 and images.max() <= 1):  # false for nan too
        raise InputError(path, key, f"floats from {images.min():g} to {images.max():g}", "uint8, or floats in [0, 1]")
    return np.rint(images * 255).astype(np.uint8)


def _intrinsics(path: Path, data: Mapping[str, np.ndarray], width: int, height: int) -> Float[Tensor, "3 3"]:
    """Of all views, pixels."""
    if "K" in data:
        return torch.from_numpy(checks.check_intrinsics(path, "K", data["K"], width, height)).float()
    checks.require_keys(path, data, ["focal"])
    focal = checks.parse_number(path, "focal", data["focal"])
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return torch.from_numpy(checks.check_intrinsics(path, "focal", K, width, height)).float()


def _background(path: Path, colour: Shaped[np.ndarray, "..."]) -> tuple[float, float, float]:
    """sRGB in [0, 1]."""
    red, green, blue = checks.parse_array(path, "background", colour, 3).tolist()
    if min(red, green, blue) < 0 or max(red, green, blue) > 1:
        raise InputError(path, "background", str([red, green, blue]), "three numbers from 0 to 1")
    return red, green, blue


def _bounds(path: Path, data: Mapping[str, np.ndarray], options: PhotoLoadOptions) -> Bounds | None:
    """The box that a file states."""
    if "aabb" not in data:
        return None
    aabb = torch.from_numpy(checks.check_box(path, "aabb", data["aabb"])).float()
    unbounded = bool(checks.parse_number(path, "unbounded", data.get("unbounded", np.array(0))))
    return Bounds(aabb, unbounded if options.bounded == "auto" else options.bounded == "false")


def save_npz(scene: Scene, path: Path) -> None:
    """Writes the course format, so that `load_npz` gives the same scene back; whole or not at all.

    Raises:
        InputError: the views do not share one K, or the folder cannot be written.
    """
    K = scene.train.cameras.K[0]
    for cameras in (scene.train.cameras, scene.val.cameras, scene.orbit):
        if not torch.equal(cameras.K, K.expand_as(cameras.K)):
            raise InputError(path, "K", "views with different intrinsics", "one K for all views of an .npz scene")
    arrays: dict[str, Tensor] = {
        "images_train": scene.train.images,
        "c2ws_train": scene.train.cameras.c2w,
        "images_val": scene.val.images,
        "c2ws_val": scene.val.cameras.c2w,
        "c2ws_test": scene.orbit.c2w,
        "focal": K[0, 0],
        "K": K,
        "aabb": scene.bounds.aabb,
    }
    for key in ("near", "far"):
        if (value := getattr(scene.bounds, key)) is not None:
            arrays[key] = torch.tensor(value, dtype=torch.float64)
    if scene.bounds.unbounded:
        arrays["unbounded"] = torch.tensor(True)
    if any(scene.background):
        arrays["background"] = torch.tensor(scene.background, dtype=torch.float64)
    if not torch.equal(scene.to_source, torch.eye(4, dtype=torch.float64)):
        arrays["to_source"] = scene.to_source
    content: dict[str, Any] = {key: array.numpy() for key, array in arrays.items()}
    with atomic(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **content)
