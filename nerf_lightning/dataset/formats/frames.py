"""The frames of transforms.json and transforms_{train,val,test}.json: photos, poses and what is said of each."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import in_other_frame
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.conventions import opengl_to_opencv
from nerf_lightning.dataset.formats.names import ImageFinder
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

REFUSED = ("k5", "k6", "s1", "s2", "s3", "s4", "rolling_shutter", "ftheta_p0", "ftheta_p1", "ftheta_p2", "latlong")
"""Keys that bend rays in ways that no lens here does; 0 and false are no lens."""
USED = {
    *("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y", "x_fov", "y_fov", "camera_model"),
    *("is_fisheye", "k1", "k2", "k3", "k4", "p1", "p2", *REFUSED),
    *("frames", "file_path", "transform_matrix", "mask_path", "applied_transform", "applied_scale"),
    *("train_filenames", "val_filenames", "test_filenames"),
}  # fmt: skip


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
    checks.require_keys(file, content, ["frames"])
    entries = content["frames"]
    if not isinstance(entries, list) or not entries or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(file, "frames", repr(entries)[:60], "objects with file_path and transform_matrix")
    poses = []
    for i, entry in enumerate(entries):
        checks.require_keys(f"{file}: frames[{i}]", entry, ["file_path", "transform_matrix"])
        if not isinstance(entry["file_path"], str):
            raise InputError(file, f"frames[{i}].file_path", repr(entry["file_path"])[:60], "a string")
        poses.append(checks.matrix(file, f"frames[{i}].transform_matrix", entry["transform_matrix"]))
    rigid = checks.rigid_poses(file, "frames[{}].transform_matrix", np.stack(poses))
    c2w = in_other_frame(torch.from_numpy(opengl_to_opencv(rigid)), torch.from_numpy(undo_applied(file, content)))
    frames = []
    for i, (entry, pose) in enumerate(zip(entries, c2w.numpy(), strict=True)):
        name, key = entry["file_path"], f"frames[{i}]"
        frames.append(Frame(name, finder.find(name, file, f"{key}.file_path"), entry, file, content, key, pose))
    finder.report(file)
    if unused := sorted({*content, *(key for entry in entries for key in entry)} - USED):
        log.info("%s: keys that are not used: %s", file, ", ".join(unused))
    return frames


def drop_missing(file: Path, frames: list[Frame]) -> list[Frame]:
    """The frames whose photo is there; a line names the others.

    Raises:
        InputError: those are the majority.
    """
    missing = sorted((frame for frame in frames if frame.image is None), key=lambda frame: frame.name)
    if 2 * len(missing) > len(frames):
        found = f"{missing[0].name!r}, which is not there (nor are {len(missing) - 1} more)"
        expected = "a photo for at least half of the frames"
        raise InputError(file, f"{missing[0].key}.file_path", found, expected, "is the images folder in place?")
    if missing:
        text = "%s: %d of %d photos are not there, %s first: left out"
        log.warning(text, file, len(missing), len(frames), missing[0].name)
    return [frame for frame in frames if frame.image is not None]


def undo_applied(file: Path, content: Mapping[str, Any]) -> Float[np.ndarray, "4 4"]:
    """Similarity from the file's world frame back to that of the capture.

    nerfstudio turns the capture by `applied_transform` and then scales it by `applied_scale`; exports have its place and unit.
    """
    applied, key = np.eye(4), "applied_transform"
    if key in content:
        applied = checks.similarity(file, key, checks.matrix(file, key, content[key]))
    applied[:3] *= checks.positive(file, "applied_scale", content.get("applied_scale", 1.0), "times")
    return np.linalg.inv(applied)
