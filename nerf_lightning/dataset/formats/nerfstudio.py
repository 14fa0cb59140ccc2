"""The nerfstudio / instant-ngp format: photos and one transforms.json with poses, intrinsics and lens distortion."""

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from nerf_lightning.cameras import Distortion
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.conventions import opengl_to_opencv
from nerf_lightning.dataset.formats.decode import find_image, image_header
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.dataset.posed import scene_of
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading, Shot
from nerf_lightning.errors import InputError

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
LEFT_OUT = ("depth_file_path", "normal_file_path", "semantics_path", "aabb_scale", "ply_file_path")
"""Keys that other programs read; the box comes from the photos and cameras."""

log = logging.getLogger(__name__)


class Frame(NamedTuple):
    name: str
    image: Path
    entry: dict
    key: str
    """Its key in the file, "frames[3]"."""
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV, the file's world frame and unit."""


def load_nerfstudio(path: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads a posed capture: OpenGL camera-to-world poses, converted to OpenCV here.

    Frames whose photo is not there are left out with a warning, as instant-ngp does (its own fox is shipped so), unless
    they are the majority: then the path is wrong. A frame's `mask_path` is its mask; without any, see `find_masks`.

    Args:
        path: transforms.json or the folder that holds it.
        name: defaults to the folder's name, or the file's if that is not transforms.json.
        reading: see there; frames are sorted by file_path, and the file may name its own split.

    Raises:
        InputError: anything missing or malformed, or a lens that is not known here.
    """
    file = path / "transforms.json" if path.is_dir() else path
    content = checks.json_object(file)
    frames = _frames(file, content)
    applied = _applied(file, content)
    optics = [_optics(file, content, frame, *image_header(frame.image)[:2]) for frame in frames]
    for key in LEFT_OUT:
        if key in content or any(key in frame.entry for frame in frames):
            log.info("%s: %s is not used", file, key)
    folder = file.resolve().parent
    named = [_mask(file, frame) for frame in frames]
    masks = named if any(named) else find_masks([frame.image for frame in frames], folder)
    shots = [
        Shot(frame.name, frame.image, applied @ frame.c2w, one, mask)
        for frame, one, mask in zip(frames, optics, masks, strict=True)
    ]
    split = _split(file, content, frames, reading.holdout)
    return scene_of(path, name or (folder.name if file.stem == "transforms" else file.stem), shots, reading, split)


def _applied(file: Path, content: dict) -> Float[np.ndarray, "4 4"]:
    """From the file's world frame back to that of the capture, which nerfstudio turns by `applied_transform`, so that several
    files made of one capture agree."""
    if "applied_transform" not in content:
        return np.eye(4)
    key, last = "applied_transform", [[0.0, 0.0, 0.0, 1.0]]
    try:
        matrix = np.array(content[key], dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(file, key, f"no matrix ({error})", "3 rows of 4 numbers") from error
    if matrix.shape not in ((3, 4), (4, 4)):
        raise InputError(file, key, f"shape {matrix.shape}", "3 rows of 4 numbers")
    matrix = checks.rigid_poses(file, key, np.concatenate([matrix[:3], last])[None])[0]
    return np.linalg.inv(matrix)


def _mask(file: Path, frame: Frame) -> Path | None:
    """The mask that a frame names."""
    name = frame.entry.get("mask_path")
    if name is None:
        return None
    key = f"{frame.key}.mask_path"
    if not isinstance(name, str):
        raise InputError(file, key, repr(name)[:60], "a string")
    if (mask := find_image(file.parent, name)) is None:
        raise InputError(file, key, f"{name!r}, which is not there", "a picture, white where the photo is kept")
    return mask


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


def _optics(file: Path, content: dict, frame: Frame, width: int, height: int) -> Optics:
    """Intrinsics of one frame: its own entries first, then the file's."""

    def key_of(key: str) -> str:
        return f"{frame.key}.{key}" if key in frame.entry else key

    def number(key: str, default: float | None = None) -> float | None:
        value = frame.entry.get(key, content.get(key))
        return default if value is None else checks.number(file, key_of(key), value)

    model = frame.entry.get("camera_model", content.get("camera_model", "OPENCV"))
    if model not in (*PERSPECTIVE, *FISHEYE):
        expected = f"one of {', '.join((*PERSPECTIVE, *FISHEYE))}"
        raise InputError(file, key_of("camera_model"), repr(model), expected)
    fisheye = model in FISHEYE or bool(frame.entry.get("is_fisheye", content.get("is_fisheye", False)))
    for key in ("k5", "k6") if fisheye else ("k4", "k5", "k6"):
        if number(key, 0.0):
            expected = "at most k1, k2, k3, k4" if fisheye else "at most k1, k2, k3, p1, p2"
            raise InputError(file, key_of(key), f"{number(key):g}", expected, "calibrate with these")
    for key, size in (("w", width), ("h", height)):
        if number(key, float(size)) != size:
            raise InputError(file, key_of(key), f"{number(key):g}", f"{size}, the size of {frame.image.name}")

    def focal(key: str, angle_key: str, size: int) -> float | None:
        if (value := number(key)) is not None:
            return checks.focal_length(file, key_of(key), checks.positive(file, key_of(key), value), size)
        if (angle := number(angle_key)) is None:
            return None
        return checks.field_of_view(file, key_of(angle_key), angle, size, fisheye)

    fx = focal("fl_x", "camera_angle_x", width)
    if fx is None:
        found = f"no focal length among [{', '.join(sorted(content))}]"
        raise InputError(file, key_of("fl_x"), found, "fl_x in pixels or camera_angle_x in radians")
    fy = focal("fl_y", "camera_angle_y", height) or fx
    # `number` gives None only where the default is None.
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    distortion = Distortion(**{key: number(key, 0.0) for key in names})  # type: ignore[arg-type]
    middle = {"cx": width / 2, "cy": height / 2}
    cx, cy = (checks.sensor(file, key_of(key), number(key, half)) for key, half in middle.items())  # type: ignore[arg-type]
    optics = Optics(width, height, fx, fy, cx, cy, distortion, fisheye)
    if not optics.sees_every_pixel():
        expected = "that of a real lens"
        raise InputError(file, ", ".join(map(key_of, names)), "a distortion that folds the photo over", expected)
    return optics
