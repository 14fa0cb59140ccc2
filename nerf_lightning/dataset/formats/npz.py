"""The course format: one .npz file with images, OpenCV camera-to-world poses and a focal length."""

import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, orbit_like
from nerf_lightning.dataset.extent import border_colour, estimate_bounds
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.arrays import Headers, read_npz
from nerf_lightning.utils.files import atomic

NEEDED = ("images_train", "c2ws_train", "images_val", "c2ws_val")
MOST_NUMBERS = 16
"""In what is neither images nor poses of views: `to_source`, a 4 x 4 matrix, has most."""
OPTIONAL = ("c2ws_test", "focal", "K", "near", "far", "aabb", "background", "unbounded", "to_source")


def load_npz(path: Path, name: str | None = None) -> Scene:
    """Reads the course format. Poses are OpenCV camera to world already: nothing is converted.

    Entries, with V views a split:
        images_train, images_val: (V, H, W, 3 or 4), uint8 or floats in [0, 1].
        c2ws_train, c2ws_val, c2ws_test: (V, 4, 4); the last is the orbit, made up like the training cameras if absent.
        focal: pixels, with the principal point in the middle; or K: (3, 3), for all views, which then rules.
        near, far: distances along the rays, and aabb: (2, 3), world units; optional, the box is estimated if absent.
        background: (3,), sRGB; if absent the one colour along the photos' borders, or black.
        unbounded: whether content lies outside aabb too, false if absent.
        to_source: (4, 4), similarity to the frame of the original, identity if absent. `save_npz` writes these three
        only where they say something.

    Raises:
        InputError: anything missing, malformed or contradictory.
    """
    data = read_npz(path, NEEDED + OPTIONAL, partial(_compare, path))
    images = {key: checks.uint8_images(path, key, data[key]) for key in ("images_train", "images_val")}
    height, width = images["images_train"].shape[1:3]
    if "K" in data:
        K = checks.intrinsics(path, "K", data["K"], width, height)
    else:
        checks.require_keys(path, data, ["focal"])
        focal = checks.positive(path, "focal", data["focal"])
        checks.focal_length(path, "focal", focal, max(width, height))
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])

    def cameras(key: str) -> Cameras:
        poses = checks.told_apart(path, checks.rigid_poses(path, key + "[{}]", data[key]), K[:1, 0])
        c2w = torch.from_numpy(poses).float()
        return Cameras.of_size(torch.from_numpy(K).float().repeat(len(c2w), 1, 1), c2w, width, height)

    def views(split: str) -> Views:
        return Views.of(torch.from_numpy(images[f"images_{split}"]), cameras(f"c2ws_{split}"))

    train, val = views("train"), views("val")
    orbit = orbit_like(train.cameras)
    if "c2ws_test" in data:
        orbit = cameras("c2ws_test")

    background = border_colour(train) or (0.0, 0.0, 0.0)
    if "background" in data:
        background = checks.colour(path, "background", data["background"])
    to_source = torch.eye(4)
    if "to_source" in data:
        to_source = torch.from_numpy(checks.similarity(path, "to_source", data["to_source"])).float()
    return Scene(
        name=name or re.sub(r"_\d+x\d+$", "", path.stem).lower(),
        source=str(path),
        train=train,
        val=val,
        orbit=orbit,
        bounds=_bounds(path, data, train, background),
        background=background,
        to_source=to_source,
    )


def _compare(path: Path, headers: Headers) -> None:
    """Compares shapes, before anything is unpacked."""
    checks.require_keys(path, headers, NEEDED)
    for key in ("images_train", "images_val"):
        checks.image_array(path, key, headers[key])
    for split in ("train", "val"):
        key, poses = f"images_{split}", f"c2ws_{split}"
        checks.pose_array(path, poses, headers[poses])
        checks.split_size(path, key, headers[key].shape[0], headers[poses].shape[0])
        checks.image_size(path, key, headers[key].shape[1:], headers["images_train"].shape[1:])
    if "c2ws_test" in headers:
        checks.pose_array(path, "c2ws_test", headers["c2ws_test"])
        checks.split_size(path, "c2ws_test", headers["c2ws_test"].shape[0])
    for key in set(headers) & set(OPTIONAL) - {"c2ws_test"}:
        if headers[key].size > MOST_NUMBERS:
            raise InputError(path, key, f"shape {headers[key].shape}", f"at most {MOST_NUMBERS} numbers")


def _bounds(path: Path, data: dict[str, np.ndarray], train: Views, background: tuple[float, float, float]) -> Bounds:
    near, far = (checks.number(path, key, data[key]) if key in data else None for key in ("near", "far"))
    checks.near_far(path, near, far)
    if "aabb" not in data:
        return estimate_bounds(train, background, near, far)
    aabb = torch.from_numpy(checks.box(path, "aabb", data["aabb"])).float()
    unbounded = False
    if "unbounded" in data:
        flag = data["unbounded"]
        if flag.shape != () or flag.dtype != bool:
            raise InputError(path, "unbounded", f"{flag.dtype}", "one true or false")
        unbounded = bool(flag)
    return Bounds(aabb, unbounded, near, far)


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
    if not torch.equal(scene.to_source, torch.eye(4)):
        arrays["to_source"] = scene.to_source
    content: dict[str, Any] = {key: array.numpy() for key, array in arrays.items()}
    try:
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **content)
    except OSError as error:
        raise InputError(path, "", f"no way to write ({error})", "a folder that exists, with space") from error
