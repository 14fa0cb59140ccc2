"""The course format: one .npz file with images, OpenCV camera-to-world poses and a focal length."""

import re
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
from nerf_lightning.utils.files import atomic

NEEDED = ("images_train", "c2ws_train", "images_val", "c2ws_val")
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
    data = checks.read_npz(path, NEEDED + OPTIONAL, NEEDED)
    images = {key: checks.uint8_images(path, key, data[key]) for key in ("images_train", "images_val")}
    size = images["images_train"].shape[1:]
    height, width = size[:2]
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
        key, poses = f"images_{split}", f"c2ws_{split}"
        checks.split_size(path, key, len(images[key]), len(np.atleast_1d(data[poses])))
        checks.image_size(path, key, images[key], size)
        return Views.of(torch.from_numpy(images[key]), cameras(poses))

    train, val = views("train"), views("val")
    orbit = orbit_like(train.cameras)
    if "c2ws_test" in data:
        orbit = cameras("c2ws_test")
        checks.split_size(path, "c2ws_test", len(orbit))

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
