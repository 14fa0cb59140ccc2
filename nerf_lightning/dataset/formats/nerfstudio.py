"""The nerfstudio / instant-ngp format: photos and one transforms.json with poses, intrinsics and lens distortion."""

import logging
import math
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, focus_point, orbit_like
from nerf_lightning.dataset.extent import estimate_bounds, viewing_distance
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.conventions import opengl_to_opencv
from nerf_lightning.dataset.formats.decode import find_image, read_images, read_pixels
from nerf_lightning.dataset.lens import Lens, rectify
from nerf_lightning.dataset.resize import area_resize, fit_size
from nerf_lightning.dataset.scene import Scene, Views
from nerf_lightning.errors import InputError

BLACK = (0.0, 0.0, 0.0)
PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")

log = logging.getLogger(__name__)


class Frame(NamedTuple):
    name: str
    image: Path
    entry: dict
    key: str
    """Its key in the file, "frames[3]"."""
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV, the file's world frame and unit."""


def load_nerfstudio(path: Path, name: str | None = None, resize: int | None = None, holdout: int = 10) -> Scene:
    """Reads a posed capture: OpenGL camera-to-world poses, converted to OpenCV here; lens distortion undone.

    The world is moved to what the training cameras look at and scaled so that their median distance to it is 1; its
    axes keep the file's directions (up is whatever it was). `to_source` leads back. Photos with alpha give a bounded
    scene; those without an unbounded one around the cube [-1, 1]^3.

    Frames whose photo is not there are left out with a warning, as instant-ngp does (its own fox is shipped so), unless
    they are the majority: then the path is wrong.

    Args:
        path: transforms.json or the folder that holds it.
        name: defaults to the folder's name, or the file's if that is not transforms.json.
        resize: longest side in pixels after averaging, if smaller than the photos.
        holdout: N to hold out every N-th frame, sorted by file_path, unless the file names its own split.

    Raises:
        InputError: anything missing, malformed, of unequal size, or a lens that is not a perspective one.
    """
    file = path / "transforms.json" if path.is_dir() else path
    content = checks.read_json(file)
    frames = _frames(file, content)
    train, val = _split(file, content, frames, holdout)

    height, width = read_pixels(frames[0].image).shape[:2]
    lenses = [_lens(file, content, frame, width, height) for frame in frames]
    # A capture has one lens, or one for each photo: keep the maps of a few, not of hundreds.
    undistort = lru_cache(maxsize=4)(rectify)
    new_width, new_height = fit_size(width, height, resize)

    def process(index: int, image: UInt8[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "h w C"]:
        return area_resize(undistort(lenses[index]).apply(image), new_width, new_height)

    K = torch.from_numpy(np.stack([undistort(lens).K for lens in lenses])).float()
    if not (torch.isfinite(K).all() and (K[:, [0, 1], [0, 1]] > 0).all()):
        raise InputError(file, "k1, k2, k3, p1, p2", "a distortion that folds the photo over", "that of a real lens")
    c2w = torch.from_numpy(np.stack([frame.c2w for frame in frames])).float()
    c2w, to_source = _normalised(c2w, c2w[train])
    cameras = Cameras(K, c2w, width, height).resized(new_width, new_height)
    views = Views(torch.from_numpy(read_images([frame.image for frame in frames], process)), cameras)
    train_views, val_views = views[torch.tensor(train)], views[torch.tensor(val)]
    bounds = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]), unbounded=True)
    if views.images.shape[3] == 4:
        bounds = estimate_bounds(train_views, BLACK)
    folder = file.resolve().parent
    return Scene(
        name=name or (folder.name if file.stem == "transforms" else file.stem).lower(),
        source=str(path),
        train=train_views,
        val=val_views,
        orbit=orbit_like(train_views.cameras),
        bounds=bounds,
        background=BLACK,
        to_source=to_source,
    )


def _frames(file: Path, content: dict) -> list[Frame]:
    """The frames whose photo is on disk, sorted by file_path."""
    names, poses = checks.json_frames(file, content)
    frames, missing = [], []
    for i, (file_path, c2w) in enumerate(zip(names, opengl_to_opencv(poses), strict=True)):
        if (image := find_image(file.parent, file_path)) is None:
            missing.append(file_path)
        else:
            frames.append(Frame(file_path, image, content["frames"][i], f"frames[{i}]", c2w))
    missing.sort()
    if len(missing) > len(frames):
        key = f"frames[{names.index(missing[0])}].file_path"
        found = f"{missing[0]!r}, which is not there (nor are {len(missing) - 1} more)"
        raise InputError(file, key, found, "a photo for at least half of the frames", "is the images folder in place?")
    if missing:
        log.warning("%s: %d of %d photos are not there, %s first: left out", file, len(missing), len(names), missing[0])
    return sorted(frames, key=lambda frame: frame.name)


def _split(file: Path, content: dict, frames: list[Frame], holdout: int) -> tuple[list[int], list[int]]:
    """Indices of training and held-out frames: as the file says, or every `holdout`-th held out."""
    if holdout < 2:
        raise InputError("holdout", "", str(holdout), "2 or more: every N-th photo is held out")
    held_key = "val_filenames" if "val_filenames" in content else "test_filenames"
    named = {}
    everything = {entry.get("file_path") for entry in content["frames"]}
    for key in ("train_filenames", held_key):
        if key not in content:
            continue
        if not isinstance(content[key], list) or not all(isinstance(item, str) for item in content[key]):
            raise InputError(file, key, repr(content[key])[:60], "a list of file_path strings")
        if strangers := set(content[key]) - everything:
            raise InputError(file, key, f"{min(strangers)!r}, which is no frame", "the file_path of a frame")
        named[key] = set(content[key])
    names = [frame.name for frame in frames]
    if held_key in named:
        val = [i for i, name in enumerate(names) if name in named[held_key]]
    elif "train_filenames" in named:
        val = [i for i, name in enumerate(names) if name not in named["train_filenames"]]
    else:
        val = list(range(0, len(names), holdout))
    val_names = {names[i] for i in val}
    train_names = named.get("train_filenames", everything - val_names)
    train = [i for i, name in enumerate(names) if name in train_names]
    if both := sorted(train_names & val_names):
        found = f"{both[0]!r}, which is in train_filenames too"
        raise InputError(file, held_key, found, "held-out photos of their own")
    checks.split_size(file, "train split", len(train))
    checks.split_size(file, "val split", len(val))
    return train, val


def _lens(file: Path, content: dict, frame: Frame, width: int, height: int) -> Lens:
    """Intrinsics of one frame: its own entries first, then the file's."""

    def key_of(key: str) -> str:
        return f"{frame.key}.{key}" if key in frame.entry else key

    def number(key: str, default: float | None = None) -> float | None:
        value = frame.entry.get(key, content.get(key))
        return default if value is None else checks.number(file, key_of(key), value)

    model = frame.entry.get("camera_model", content.get("camera_model", "OPENCV"))
    if model not in PERSPECTIVE or content.get("is_fisheye"):
        found = repr(model) if model not in PERSPECTIVE else "is_fisheye"
        raise InputError(file, key_of("camera_model"), found, f"a perspective lens: {', '.join(PERSPECTIVE)}")
    for key in ("k4", "k5", "k6"):
        if number(key, 0.0):
            found = f"{number(key):g}"
            raise InputError(file, key_of(key), found, "at most k1, k2, k3, p1, p2", "calibrate with these")
    for key, size in (("w", width), ("h", height)):
        if number(key, float(size)) != size:
            raise InputError(file, key_of(key), f"{number(key):g}", f"{size}, the size of {frame.image.name}")

    def focal(key: str, angle_key: str, size: int) -> float | None:
        if (value := number(key)) is not None:
            return checks.positive(file, key_of(key), value)
        if (angle := number(angle_key)) is None:
            return None
        if not 0 < angle < math.pi:
            raise InputError(file, key_of(angle_key), f"{angle:g}", "radians between 0 and pi")
        return 0.5 * size / math.tan(0.5 * angle)

    fx = focal("fl_x", "camera_angle_x", width)
    if fx is None:
        found = f"no focal length among [{', '.join(sorted(content))}]"
        raise InputError(file, key_of("fl_x"), found, "fl_x in pixels or camera_angle_x in radians")
    fy = focal("fl_y", "camera_angle_y", height) or fx
    # `number` gives None only where the default is None.
    distortion = tuple(number(key, 0.0) for key in ("k1", "k2", "p1", "p2", "k3"))
    centre = number("cx", width / 2), number("cy", height / 2)
    return Lens(width, height, fx, fy, *centre, distortion)  # type: ignore[arg-type]


def _normalised(
    c2w: Float[Tensor, "V 4 4"], train: Float[Tensor, "T 4 4"]
) -> tuple[Float[Tensor, "V 4 4"], Float[Tensor, "4 4"]]:
    """Poses in a frame centred on what `train` looks at, median distance 1, and the similarity back."""
    centre = focus_point(train)
    scale = viewing_distance(train, centre)
    moved = c2w.clone()
    moved[:, :3, 3] = (c2w[:, :3, 3] - centre) / scale
    to_source = torch.eye(4)
    to_source[:3, :3] *= scale
    to_source[:3, 3] = centre
    return moved, to_source
