"""Posed photos in JSON: transforms.json of nerfstudio and instant-ngp, transforms_{train,val,test}.json of the NeRF paper."""

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Cameras, Distortion, Projection
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.conventions import opengl_to_opencv
from nerf_lightning.dataset.formats.names import ImageFinder, fold_name
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.optics import Optics, equirectangular
from nerf_lightning.dataset.orientation import OrientationChooser
from nerf_lightning.dataset.posed import Hints, Split, build_scene, split_shots
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading, Shot
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
EQUIRECTANGULAR = "EQUIRECTANGULAR"
INTRINSICS = {
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_model"),
    *("is_fisheye", "k1", "k2", "k3", "k4", "p1", "p2"),
}
"""Keys of a camera, of the file or of one frame, which goes first."""
REFUSED = ("k5", "k6", "s1", "s2", "s3", "s4", "rolling_shutter", "ftheta_p0", "ftheta_p1", "ftheta_p2", "latlong")
"""Keys that bend rays in ways that no lens here does; 0 and false are no lens."""
USED = {
    *INTRINSICS, *REFUSED,
    *("frames", "file_path", "transform_matrix", "mask_path", "applied_transform", "applied_scale"),
    *("train_filenames", "val_filenames", "test_filenames"),
}  # fmt: skip
WITHOUT_GEOMETRY = {
    "rotation",
    "sharpness",
    "aabb_scale",
    "scale",
    "offset",
    "colmap_im_id",
    "camera_label",
    "orientation_override",
}
"""Keys that say nothing about where photos were taken: settings of other programs, and what a renderer did between frames."""
WHITE = (1.0, 1.0, 1.0)
MAX_FOCAL_DISAGREEMENT = 0.02
"""Most relative difference of a focal length and an angle of view that say the same."""


class Frame(NamedTuple):
    """One entry of `frames`."""

    name: str
    image: Path | None
    """The photo; None where it is not there."""
    entry: Mapping[str, Any]
    file: Path
    content: Mapping[str, Any]
    """The JSON file it stands in, and what that says of all frames."""
    key: str
    """Its key in the file, "frames[3]"."""
    c2w: Float[np.ndarray, "4 4"]
    """OpenCV, the capture's world frame and unit."""

    def get(self, key: str) -> Any:
        """A value of the frame, or else of the file; None where neither has one."""
        value = self.entry.get(key)
        return self.content.get(key) if value is None else value

    def name_key(self, key: str) -> str:
        """Where a key stands, for messages."""
        return f"{self.key}.{key}" if key in self.entry else key

    def number(self, key: str) -> float | None:
        """A number, if it is there.

        Raises:
            InputError: it is none.
        """
        value = self.get(key)
        return None if value is None else checks.number(self.file, self.name_key(key), value)


def load_transforms(path: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads transforms.json: OpenGL camera-to-world poses, converted to OpenCV here.

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
    frames = sorted(drop_missing(file, read_frames(file, ImageFinder(file.parent))), key=lambda frame: frame.name)
    folder = file.resolve().parent
    split = read_split(frames) or split_shots(file, len(frames), reading.holdout)
    shots = read_cameras(file, frames, folder, reading)
    return build_scene(path, name or (folder.name if file.stem == "transforms" else file.stem), shots, reading, split)


def load_blender(folder: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads transforms_train.json, transforms_val.json and transforms_test.json, as the NeRF paper's renders have them.

    Every key of transforms.json counts. Held out is the val split, or test where val has no photos; with both, test is
    measured on at the end. A split whose photos are not there is a camera path; where no photos are held out, every
    `reading.holdout`-th of the train split is. Photos with alpha stand on white, the format's convention.

    Args:
        folder: holds transforms_train.json.
        name: defaults to the folder's name.
        reading: see there.

    Raises:
        InputError: anything missing or malformed.
    """
    finder = ImageFinder(folder)
    frames: list[Frame] = []
    indices: dict[str, list[int]] = {}
    path = None
    for split in ("train", "val", "test"):
        file = folder / f"transforms_{split}.json"
        if split != "train" and not file.is_file():
            continue
        found = read_frames(file, finder)
        if split != "train" and not any(frame.image for frame in found):
            log.warning("%s: none of its %d photos is there: taken as a camera path", file, len(found))
            path = found if path is None or split == "test" else path
            continue
        found = drop_missing(file, found)
        indices[split] = list(range(len(frames), len(frames) + len(found)))
        frames += found
    shots = read_cameras(folder, frames, folder, reading)
    held_out = [indices[key] for key in ("val", "test") if key in indices]
    if held_out:
        parts = Split(indices["train"], held_out[0], held_out[1] if len(held_out) > 1 else [])
    else:
        parts = split_shots(folder, len(frames), reading.holdout)
        log.warning("%s: no held-out photos: every %d-th training photo is held out", folder, reading.holdout)
    cameras = None if path is None else make_path(path, shots[0].optics)
    hints = Hints(alpha_background=WHITE, keep_frame=True, path=cameras)
    return build_scene(folder, name or folder.resolve().name, shots, reading, parts, hints)


def read_frames(file: Path, finder: ImageFinder) -> list[Frame]:
    """All frames of a JSON file in its order, those without a photo too. Unknown keys are listed once.

    Raises:
        InputError: no frames, or poses that are none.
    """
    content = checks.json_object(file)
    names, poses = checks.json_frames(file, content)
    undo = undo_applied(file, content)
    c2w = opengl_to_opencv(poses)
    c2w[:, :3, 3] = c2w[:, :3, 3] @ undo[:3, :3].T + undo[:3, 3]
    c2w[:, :3, :3] = (undo[:3, :3] / np.cbrt(np.linalg.det(undo[:3, :3]))) @ c2w[:, :3, :3]
    frames = [
        Frame(name, finder.find(name, file, f"frames[{i}].file_path"), entry, file, content, f"frames[{i}]", pose)
        for i, (name, entry, pose) in enumerate(zip(names, content["frames"], c2w, strict=True))
    ]
    finder.report(file)
    report_unused(file, content, frames)
    return frames


def report_unused(file: Path, content: Mapping[str, Any], frames: Sequence[Frame]) -> None:
    """Lists once the keys that nothing here reads."""
    keys = set(content) | {key for frame in frames for key in frame.entry}
    if unused := sorted(keys - USED - WITHOUT_GEOMETRY):
        log.info("%s: keys that are not used: %s", file, ", ".join(unused))


def drop_missing(file: Path, frames: list[Frame]) -> list[Frame]:
    """The frames whose photo is there; a line names the others.

    Raises:
        InputError: those are the majority.
    """
    missing = sorted((frame for frame in frames if frame.image is None), key=lambda frame: frame.name)
    if 2 * len(missing) > len(frames):
        more = f" (nor are {len(missing) - 1} more)" if len(missing) > 1 else ""
        found = f"{missing[0].name!r}, which is not there{more}"
        expected = "a photo for at least half of the frames"
        raise InputError(file, f"{missing[0].key}.file_path", found, expected, "is the images folder in place?")
    if missing:
        log.warning(
            "%s: %d of %d photos are not there, %s first: left out", file, len(missing), len(frames), missing[0].name
        )
    return [frame for frame in frames if frame.image is not None]


def undo_applied(file: Path, content: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Similarity from the file's world frame back to that of the capture.

    nerfstudio turns the capture by `applied_transform` and then scales it by `applied_scale`; exports have its place and unit.
    """
    applied = np.eye(4)
    if "applied_transform" in content:
        key = "applied_transform"
        try:
            matrix = np.array(content[key], dtype=np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(file, key, f"no matrix ({error})", "3 rows of 4 numbers") from error
        if matrix.shape not in ((3, 4), (4, 4)):
            raise InputError(file, key, f"shape {matrix.shape}", "3 rows of 4 numbers")
        applied[:3] = checks.similarity(file, key, np.concatenate([matrix[:3], [[0.0, 0.0, 0.0, 1.0]]]))[:3]
    scale = checks.positive(file, "applied_scale", content.get("applied_scale", 1.0), "times")
    applied[:3] *= scale
    return np.linalg.inv(applied)


def read_split(frames: list[Frame]) -> Split | None:
    """The split that a file names; None where it names none.

    Raises:
        InputError: names that are no frame's, or photos in two parts of it.
    """
    if not frames:
        return None
    file, content = frames[0].file, frames[0].content
    folded = {fold_name(entry["file_path"]) for entry in content["frames"]}
    named: dict[str, set[tuple[str, ...]]] = {}
    for key in ("train_filenames", "val_filenames", "test_filenames"):
        if (given := content.get(key)) is None:
            continue
        if not isinstance(given, list) or not all(isinstance(item, str) for item in given):
            raise InputError(file, key, repr(given)[:60], "a list of file_path strings")
        if strangers := [item for item in given if fold_name(item) not in folded]:
            raise InputError(file, key, f"{strangers[0]!r}, which is no frame", "the file_path of a frame")
        if given:
            named[key] = {fold_name(item) for item in given}
    if not named:
        return None
    own = [fold_name(frame.name) for frame in frames]

    def select(key: str) -> list[int]:
        return [i for i, name in enumerate(own) if name in named.get(key, ())]

    train, val, test = (select(key) for key in ("train_filenames", "val_filenames", "test_filenames"))
    if "train_filenames" not in named:
        train = [i for i in range(len(frames)) if i not in {*val, *test}]
    if not val and not test:
        val = [i for i in range(len(frames)) if i not in set(train)]
    if not val:
        val, test = test, []
    for key, part in (("val_filenames", val), ("test_filenames", test)):
        if both := sorted(set(part) & set(train)):
            found = f"{frames[both[0]].name!r}, which is in train_filenames too"
            raise InputError(file, key if key in named else "test_filenames", found, "held-out photos of their own")
    test = test if test != val else []
    checks.split_size(file, "train split", len(train))
    checks.split_size(file, "val split", len(val))
    return Split(train, val, test)


def read_cameras(source: Path, frames: list[Frame], folder: Path, reading: Reading) -> list[Shot]:
    """The posed photos of frames that have one.

    Raises:
        InputError: intrinsics or masks that are none.
    """
    orientation = OrientationChooser(reading.orientation)
    shots: list[Shot] = []
    masks = read_mask_paths(frames, folder)
    for frame, mask in zip(frames, masks, strict=True):
        assert frame.image is not None  # the others were left out
        stated = read_size(frame)
        width, height, upright = orientation.choose(frame.image, stated)
        if stated is not None and stated != (width, height) and not shots:
            text = "%s: intrinsics are of photos of %dx%d; they are scaled to the photos there, of %dx%d"
            log.warning(text, source, *stated, width, height)
        optics = read_optics(frame, *(stated or (width, height)))
        shots.append(Shot(frame.name, frame.image, frame.c2w, optics, mask, upright))
    orientation.report(source)
    return shots


def read_mask_paths(frames: list[Frame], folder: Path) -> list[Path | None]:
    """The masks that frames name, or else those found beside the photos.

    Raises:
        InputError: a named mask that is not there.
    """
    if not any(frame.entry.get("mask_path") for frame in frames):
        return find_masks([frame.image for frame in frames if frame.image is not None], folder)
    finder = ImageFinder(folder)
    masks: list[Path | None] = []
    for frame in frames:
        name, key = frame.entry.get("mask_path"), f"{frame.key}.mask_path"
        if name is None:
            masks.append(None)
            continue
        if not isinstance(name, str):
            raise InputError(frame.file, key, repr(name)[:60], "a string")
        if (mask := finder.find(name, frame.file, key)) is None:
            found, expected = f"{name!r}, which is not there", "an image, white where the photo is kept"
            raise InputError(frame.file, key, found, expected)
        masks.append(mask)
    finder.report(frames[0].file)
    return masks


def read_size(frame: Frame) -> tuple[int, int] | None:
    """Width and height in pixels that a file states for a camera, None where it states none."""
    sides = [frame.number(key) for key in ("w", "h")]
    if None in sides:
        return None
    for key, side in zip(("w", "h"), sides, strict=True):
        if not side or not 1 <= side <= checks.PIXELS:
            raise InputError(frame.file, frame.name_key(key), f"{side:g}", "the pixels of a photo")
    width, height = (max(1, round(side)) for side in sides if side)
    return width, height


def read_optics(frame: Frame, width: int, height: int) -> Optics:
    """Intrinsics of one frame for photos of a size, in pixels of that size.

    Raises:
        InputError: no focal length, or a lens that is not known here.
    """
    file, name_key = frame.file, frame.name_key
    model = frame.get("camera_model") or "OPENCV"
    if model == EQUIRECTANGULAR:
        if abs(width - 2 * height) > 2:
            found, expected = f"{model} of {width}x{height} pixels", "photos twice as wide as high, of all directions"
            raise InputError(file, name_key("camera_model"), found, expected)
        return equirectangular(width, height)
    if model not in (*PERSPECTIVE, *FISHEYE):
        expected = f"one of {', '.join((*PERSPECTIVE, *FISHEYE, EQUIRECTANGULAR))}"
        raise InputError(file, name_key("camera_model"), repr(model)[:60], expected)
    fisheye = model in FISHEYE or bool(frame.get("is_fisheye"))
    for key in REFUSED if fisheye else (*REFUSED, "k4"):
        value = frame.get(key)
        if any(value) if isinstance(value, list) else value not in (None, False, 0, "0"):
            expected = "at most k1, k2, k3, k4" if fisheye else "at most k1, k2, k3, p1, p2"
            raise InputError(file, name_key(key), repr(value)[:60], expected, "calibrate or export with these alone")
    found_x, found_y = read_focal(frame, "x", width, fisheye), read_focal(frame, "y", height, fisheye)
    fx, fy = found_x or found_y, found_y or found_x
    if fx is None or fy is None:
        found = f"no focal length among [{', '.join(sorted({**frame.content, **frame.entry}))}]"
        raise InputError(file, name_key("fl_x"), found, "fl_x in pixels or camera_angle_x in radians")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    distortion = Distortion(**{key: frame.number(key) or 0.0 for key in names})
    cx, cy = read_place(frame, "cx", width), read_place(frame, "cy", height)
    checks.principal_point(file, f"{name_key('cx')}, {name_key('cy')}", cx, cy, width, height)
    optics = Optics(
        width, height, fx, fy, cx, cy, distortion, Projection.FISHEYE if fisheye else Projection.PERSPECTIVE
    )
    if not optics.sees_every_pixel():
        expected = "that of a real lens"
        raise InputError(file, ", ".join(map(name_key, names)), "a distortion that folds the photo over", expected)
    return optics


def read_place(frame: Frame, key: str, side: int) -> float:
    """The principal point along a side in pixels; the middle where the file does not state it."""
    given = frame.number(key)
    return side / 2 if given is None else checks.sensor(frame.file, frame.name_key(key), given)


def read_focal(frame: Frame, axis: str, side: int, fisheye: bool) -> float | None:
    """Focal length along an axis in pixels: `fl_x` first, then `camera_angle_x` in radians, then `x_fov` in degrees.

    Raises:
        InputError: a length or an angle that no camera has.
    """
    file, key, angle_key, degrees_key = frame.file, f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"
    angle, degrees = frame.number(angle_key), frame.number(degrees_key)
    by_angle = None
    if angle is not None:
        if math.pi <= angle < 180:
            found, todo = f"{angle:g}", f"it seems to be in degrees: write {math.radians(angle):.6g}"
            raise InputError(file, frame.name_key(angle_key), found, "an angle in radians, below pi", todo)
        by_angle = checks.field_of_view(file, frame.name_key(angle_key), angle, side, fisheye)
    elif degrees is not None:
        by_angle = checks.field_of_view(file, frame.name_key(degrees_key), math.radians(degrees), side, fisheye)
    if (given := frame.number(key)) is None:
        return by_angle
    focal = checks.focal_length(file, frame.name_key(key), checks.positive(file, frame.name_key(key), given), side)
    if by_angle is not None and abs(by_angle / focal - 1) > MAX_FOCAL_DISAGREEMENT and frame.key == "frames[0]":
        text = "%s: %s=%.5g and the angle of view, which says %.5g, disagree: %s is taken"
        log.warning(text, file, key, focal, by_angle, key)
    return focal


def make_path(frames: list[Frame], optics: Optics) -> Cameras:
    """Pinhole cameras along the poses of frames without photos, with the intrinsics of a photo."""
    c2w = torch.from_numpy(np.stack([frame.c2w for frame in frames]))
    K = torch.from_numpy(optics.K).repeat(len(frames), 1, 1)
    return Cameras.of_size(K.float(), c2w, optics.width, optics.height)
