"""The course format: one .npz file with images, OpenCV camera-to-world poses and a focal length."""

import logging
import re
import zipfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.posed import Hints, PosedViews, assemble_scene, split_shots
from nerf_lightning.dataset.resize import fit_size, resize_views
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading
from nerf_lightning.dataset.size import choose_resize
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic
from nerf_lightning.utils.parsing import Headers, read_npz

log = logging.getLogger(__name__)

NEEDED = ("images_train", "c2ws_train")
PAIRS = {"images_train": "c2ws_train", "images_val": "c2ws_val", "images_test": "c2ws_test"}
"""Images of each split, and their poses."""
MAX_NUMBERS = 16
"""In what is neither images nor poses of views: `to_source`, a 4 x 4 matrix, has most."""
SCALARS = ("focal", "K", "near", "far", "aabb", "background", "unbounded", "to_source")


def load_npz(path: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads the course format. Poses are OpenCV camera to world already: nothing is converted.

    Entries, with V views a split:
        images_train, images_val, images_test: (V, H, W, 3 or 4), uint8 or floats in [0, 1]; without val, test is held out, or
            every `reading.holdout`-th of train.
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
    data = read_npz(path, (*PAIRS, *PAIRS.values(), *SCALARS), partial(_compare, path))
    with zipfile.ZipFile(path) as archive:
        names = {member.removesuffix(".npy") for member in archive.namelist()}
    if unused := sorted(names - {*PAIRS, *PAIRS.values(), *SCALARS}):
        log.info("%s: keys that are not used: %s", path, ", ".join(unused))
    images = {key: checks.uint8_images(path, key, data[key]) for key in PAIRS if key in data}
    height, width = images["images_train"].shape[1:3]
    K = _intrinsics(path, data, width, height)

    def cameras(c2w: Float[np.ndarray, "V 4 4"]) -> Cameras:
        return Cameras.of_size(K.repeat(len(c2w), 1, 1), torch.from_numpy(c2w), width, height)

    poses = {key: checks.rigid_poses(path, key + "[{}]", data[key]) for key in PAIRS.values() if key in data}
    posed = {
        key: PosedViews(Views.of(torch.from_numpy(images[key]), cameras(poses[PAIRS[key]])), poses[PAIRS[key]])
        for key in images
    }
    train, val, test = (posed.get(key) for key in PAIRS)
    if val is None:
        val, test = test, None
    assert train is not None  # as was checked
    if val is None:
        log.warning("%s: no held-out photos: every %d-th training photo is held out", path, reading.holdout)
        split = split_shots(path, len(train.c2w), reading.holdout)
        train, val = (PosedViews(train.views[torch.tensor(part)], train.c2w[part]) for part in (split.train, split.val))
    longest = choose_resize(path, [(width, height)] * len(data["c2ws_train"]), train.views.channels, reading.resize)
    if longest is not None:
        train, val, test = (None if one is None else _resize(one, longest) for one in (train, val, test))
        assert train is not None and val is not None
    path_poses = poses.get("c2ws_test") if "images_test" not in data else None
    hints = Hints(
        keep_frame=True,
        path=None if path_poses is None else cameras(path_poses).resized(fit_size(width, height, longest)),
        background=checks.colour(path, "background", data["background"]) if "background" in data else None,
        bounds=_bounds(path, data, reading),
        to_source=checks.similarity(path, "to_source", data["to_source"]) if "to_source" in data else None,
        near=checks.number(path, "near", data["near"]) if "near" in data else None,
        far=checks.number(path, "far", data["far"]) if "far" in data else None,
    )
    checks.near_far(path, hints.near, hints.far)
    return assemble_scene(path, name or re.sub(r"_\d+x\d+$", "", path.stem).lower(), train, val, test, reading, hints)


def _resize(posed: PosedViews, longest: int) -> PosedViews:
    return replace(posed, views=resize_views(posed.views, longest))


def _intrinsics(path: Path, data: dict[str, np.ndarray], width: int, height: int) -> Float[Tensor, "3 3"]:
    """Of all views, pixels."""
    if "K" in data:
        K = checks.intrinsics(path, "K", data["K"], width, height)
        checks.principal_point(path, "K", K[0, 2], K[1, 2], width, height)
        return torch.from_numpy(K).float()
    checks.require_keys(path, data, ["focal"])
    focal = checks.positive(path, "focal", data["focal"])
    checks.focal_length(path, "focal", focal, max(width, height))
    return torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])


def _compare(path: Path, headers: Headers) -> None:
    """Compares shapes, before anything is unpacked."""
    checks.require_keys(path, headers, NEEDED)
    for key, pose_key in PAIRS.items():
        if pose_key in headers:
            checks.pose_array(path, pose_key, headers[pose_key])
            checks.split_size(path, pose_key, headers[pose_key].shape[0])
        if key in headers:
            checks.require_keys(path, headers, [pose_key])
            checks.image_array(path, key, headers[key])
            checks.split_size(path, key, headers[key].shape[0], headers[pose_key].shape[0])
            checks.image_size(path, key, headers[key].shape[1:], headers["images_train"].shape[1:])
    for key in set(headers) & set(SCALARS):
        if headers[key].size > MAX_NUMBERS:
            raise InputError(path, key, f"shape {headers[key].shape}", f"at most {MAX_NUMBERS} numbers")


def _bounds(path: Path, data: dict[str, np.ndarray], reading: Reading) -> Bounds | None:
    """The box that a file states."""
    if "aabb" not in data:
        return None
    aabb = torch.from_numpy(checks.box(path, "aabb", data["aabb"])).float()
    flag = data.get("unbounded", np.array(False))
    if flag.shape != () or flag.dtype != bool:
        raise InputError(path, "unbounded", f"{flag.dtype}", "one true or false")
    return Bounds(aabb, bool(flag) if reading.bounded == "auto" else reading.bounded == "false")


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
    try:
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **content)
    except OSError as error:
        raise InputError(path, "", f"no way to write ({error})", "a folder that exists, with space") from error
