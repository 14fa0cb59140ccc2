"""The frames of transforms.json and transforms_{train,val,test}.json: photos, poses and what is said of each."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.conventions import opengl_to_opencv
from nerf_lightning.dataset.formats.names import ImageFinder
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

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


def read_frames(file: Path, finder: ImageFinder) -> list[Frame]:
    """All frames of a JSON file in its order, those without a photo too. Unknown keys are listed once.

    Raises:
        InputError: no frames, or poses that are none.
    """
    content = checks.json_object(file)
    names, poses = read_poses(file, content)
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


def read_poses(path: Path, content: dict) -> tuple[list[str], Float[np.ndarray, "V 4 4"]]:
    """File names and camera-to-world matrices of `frames`, in the file's own camera convention."""
    checks.require_keys(path, content, ["frames"])
    frames = content["frames"]
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(path, "frames", "something else", "a list of objects with file_path and transform_matrix")
    if not frames:
        raise InputError(path, "frames", "an empty list", "at least one frame")
    poses = []
    for i, frame in enumerate(frames):
        checks.require_keys(f"{path}: frames[{i}]", frame, ["file_path", "transform_matrix"])
        if not isinstance(frame["file_path"], str):
            raise InputError(path, f"frames[{i}].file_path", repr(frame["file_path"])[:60], "a string")
        key = f"frames[{i}].transform_matrix"
        try:
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(path, key, f"no matrix ({error})", "4 rows of 4 numbers") from error
        if pose.shape not in ((4, 4), (3, 4)):
            raise InputError(path, key, f"shape {pose.shape}", "4 rows of 4 numbers")
        poses.append(pose if len(pose) == 4 else np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]]))
    return [frame["file_path"] for frame in frames], checks.rigid_poses(
        path, "frames[{}].transform_matrix", np.stack(poses)
    )


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
