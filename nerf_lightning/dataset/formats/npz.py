"""Course format: one .npz file with images, OpenCV camera-to-world poses and a focal length."""

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
from nerf_lightning.dataset.photo_loading import DEFAULT_OPTIONS, PhotoLoadOptions
from nerf_lightning.dataset.resize import choose_resize, fit_size, resize_area
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_builder import Hints, assemble_scene, split_photos
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic_write
from nerf_lightning.utils.parsing import read_npz

log = logging.getLogger(__name__)

REQUIRED_KEYS = ("images_train", "c2ws_train")
POSE_KEYS = {"images_train": "c2ws_train", "images_val": "c2ws_val", "images_test": "c2ws_test"}
"""Image key of each split -> its pose key."""
OPTIONAL_KEYS = ("focal", "K", "near", "far", "aabb", "background", "unbounded", "core", "to_source")


def load_npz(path: Path, name: str | None = None, options: PhotoLoadOptions = DEFAULT_OPTIONS) -> Scene:
    """Reads the course format. Poses are OpenCV camera to world: nothing is converted.

    Entries, with V views a split:
        images_train, images_val, images_test: (V, H, W, 3 or 4), uint8 or floats in [0, 1]; without val, test is held out, or
            every `options.holdout`-th of train.
        c2ws_train, c2ws_val, c2ws_test: (V, 4, 4); the last without images is the orbit, generated if absent.
        focal: pixels, with the principal point in the middle; or K: (3, 3), for all views, which takes precedence.
        near, far: distances along the rays, and aabb: (2, 3), world units, with unbounded: whether content lies outside aabb
            too, and core: (2, 3), see `Bounds.core`; without aabb the photos are classified, see `classify_scene`.
        background: (3,), sRGB; defaults to the uniform border color of the photos, or black.
        to_source: (4, 4), similarity to the frame of the source; defaults to the identity.

    Raises:
        InputError: an entry is missing, malformed or contradictory.
    """
    data = read_npz(path, (*POSE_KEYS, *POSE_KEYS.values(), *OPTIONAL_KEYS))
    checks.require_keys(path, data, REQUIRED_KEYS)
    images = {key: read_images(path, key, data) for key in POSE_KEYS if key in data}
    count, height, width, channels = images["images_train"].shape
    size = fit_size(width, height, choose_resize(path, [(width, height)] * count, channels, options.resize))
    K = read_intrinsics(path, data, width, height)

    def read_poses(key: str) -> Cameras:
        c2w = torch.from_numpy(checks.check_poses(path, key + "[{}]", data[key]))
        return Cameras.pinhole(K.repeat(len(c2w), 1, 1), c2w, width, height).resize(size)

    def make_views(key: str, stack: UInt8[np.ndarray, "V H W C"]) -> Views:
        resized = stack if size == (width, height) else np.stack([resize_area(image, *size) for image in stack])
        return Views.from_images(torch.from_numpy(resized), read_poses(POSE_KEYS[key]))

    train, *held_out = (make_views(key, stack) for key, stack in images.items())
    if not held_out:
        log.warning("%s: no held-out photos: holding out every %d-th training photo", path, options.holdout)
        split = split_photos(path, len(train), options.holdout)
        train, val = (train[torch.tensor(part)] for part in (split.train, split.val))
        held_out = [val]
    near, far = (checks.parse_number(path, key, data[key]) if key in data else None for key in ("near", "far"))
    checks.check_near_far(path, near, far)
    has_path = "c2ws_test" in data and "images_test" not in data
    hints = Hints(
        keep_frame=True,
        camera_path=read_poses("c2ws_test") if has_path else None,
        background=read_background(path, data["background"]) if "background" in data else None,
        bounds=read_bounds(path, data, options) if "aabb" in data else None,
        to_source=checks.check_similarity(path, "to_source", data["to_source"]) if "to_source" in data else None,
        near=near,
        far=far,
    )
    name = name or re.sub(r"_\d+x\d+$", "", path.stem)
    return assemble_scene(path, name, [train, *held_out], options, hints)


def read_images(path: Path, key: str, data: Mapping[str, np.ndarray]) -> UInt8[np.ndarray, "V H W C"]:
    """Reads the images of a split as uint8; floats in [0, 1] are scaled and rounded."""
    images, shape = data[key], data["images_train"].shape[1:]
    checks.require_keys(path, data, [POSE_KEYS[key]])
    if images.ndim != 4 or images.shape[3] not in (3, 4) or (images.dtype != np.uint8 and images.dtype.kind != "f"):
        expected = "images of shape (V, H, W, 3 or 4), uint8 or floats in [0, 1]"
        raise InputError(path, key, f"shape {images.shape}, {images.dtype}", expected)
    checks.check_split_size(path, key, images.size)
    if images.shape[1:] != shape:
        raise InputError(path, key, f"shape {images.shape}", f"images of shape {shape}, as in images_train")
    if (poses := data[POSE_KEYS[key]].shape[:1]) != images.shape[:1]:
        raise InputError(path, key, f"{len(images)} images for {math.prod(poses)} poses", "one pose for each image")
    if images.dtype == np.uint8:
        return images
    if not (images.min() >= 0 and images.max() <= 1):  # false for nan too
        raise InputError(path, key, f"floats from {images.min():g} to {images.max():g}", "uint8, or floats in [0, 1]")
    return np.rint(images * 255).astype(np.uint8)


def read_intrinsics(path: Path, data: Mapping[str, np.ndarray], width: int, height: int) -> Float[Tensor, "3 3"]:
    """Reads K of all views, in pixels."""
    key, K = "K", data.get("K")
    if K is None:
        checks.require_keys(path, data, ["focal"])
        key, focal = "focal", checks.parse_number(path, "focal", data["focal"])
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return torch.from_numpy(checks.check_intrinsics(path, key, K, width, height)).float()


def read_background(path: Path, color: Shaped[np.ndarray, "..."]) -> tuple[float, float, float]:
    """Reads sRGB in [0, 1]."""
    red, green, blue = checks.parse_array(path, "background", color, 3).tolist()
    if min(red, green, blue) < 0 or max(red, green, blue) > 1:
        raise InputError(path, "background", str([red, green, blue]), "three numbers from 0 to 1")
    return red, green, blue


def read_bounds(path: Path, data: Mapping[str, np.ndarray], options: PhotoLoadOptions) -> Bounds:
    """Reads the box of a file."""
    aabb = torch.from_numpy(checks.check_box(path, "aabb", data["aabb"])).float()
    unbounded = bool(checks.parse_number(path, "unbounded", data.get("unbounded", 0)))
    unbounded = unbounded if options.bounded == "auto" else options.bounded == "false"
    if not unbounded or "core" not in data:
        return Bounds(aabb, unbounded)
    return Bounds(aabb, unbounded, core=torch.from_numpy(checks.check_box(path, "core", data["core"])).float())


def save_npz(scene: Scene, path: Path) -> None:
    """Writes the course format atomically; `load_npz` restores the same scene.

    Raises:
        InputError: the views do not share one K, or the folder is not writable.
    """
    K = scene.train.cameras.K[0]
    for cameras in (scene.train.cameras, scene.val.cameras, scene.orbit):
        if not torch.equal(cameras.K, K.expand_as(cameras.K)):
            raise InputError(path, "K", "views with different intrinsics", "one K for all views of an .npz scene")
    arrays: dict[str, Any] = {
        "images_train": scene.train.images,
        "c2ws_train": scene.train.cameras.c2w,
        "images_val": scene.val.images,
        "c2ws_val": scene.val.cameras.c2w,
        "c2ws_test": scene.orbit.c2w,
        "focal": K[0, 0],
        "K": K,
        "aabb": scene.bounds.aabb,
        "unbounded": scene.bounds.unbounded,
        "core": scene.bounds.core,
        "to_source": scene.to_source,
        "near": scene.bounds.near,
        "far": scene.bounds.far,
        "background": scene.background if any(scene.background) else None,
    }
    content: dict[str, Any] = {key: np.asarray(value) for key, value in arrays.items() if value is not None}
    with atomic_write(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **content)
