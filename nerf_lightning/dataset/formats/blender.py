"""The Blender format of the original NeRF scenes: transforms_{train,val,test}.json beside RGBA renders."""

from pathlib import Path

import numpy as np

from nerf_lightning.cameras import orbit_like
from nerf_lightning.dataset.extent import border_colour, estimate_bounds
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.conventions import opengl_to_opencv
from nerf_lightning.dataset.formats.decode import find_image, image_header
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import Reading, Shot, read_shots
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

WHITE = (1.0, 1.0, 1.0)
NEARLY = 8 / 255
"""Borders that differ from white by less, in all channels, are white: JPEG and resampling move them so far."""


def load_blender(folder: Path, name: str | None = None, resize: int | None = None) -> Scene:
    """Reads a Blender scene: OpenGL camera-to-world poses, converted to OpenCV here.

    Held out is the val split, or test where there is no val. Renders keep their alpha; the background they are shown on
    is white by convention, or the one colour along the borders of photos without alpha.

    Args:
        folder: holds transforms_train.json and transforms_val.json or transforms_test.json.
        name: defaults to the folder's name.
        resize: longest side in pixels after averaging, if smaller than the renders.

    Raises:
        InputError: anything missing or malformed.
    """
    files = [folder / f"transforms_{split}.json" for split in ("train", "val", "test")]
    held_out = next((file for file in files[1:] if file.is_file()), None)
    if held_out is None:
        raise InputError(folder, "", "no transforms_val.json or transforms_test.json", "held-out views in one of them")
    train, val = _load_split(files[0], resize), _load_split(held_out, resize)
    background = border_colour(train) or WHITE
    if max(1 - part for part in background) <= NEARLY:
        background = WHITE
    return Scene(
        name=name or folder.resolve().name.lower(),
        source=str(folder),
        train=train,
        val=val,
        orbit=orbit_like(train.cameras),
        bounds=estimate_bounds(train, background),
        background=background,
    )


def _load_split(path: Path, resize: int | None) -> Views:
    content = checks.json_object(path)
    checks.require_keys(path, content, ["camera_angle_x", "frames"])
    angle = checks.positive(path, "camera_angle_x", content["camera_angle_x"], "radians")
    names, poses = checks.json_frames(path, content)
    shots = []
    for i, (file_path, c2w) in enumerate(zip(names, opengl_to_opencv(poses), strict=True)):
        if (file := find_image(path.parent, file_path)) is None:
            raise InputError(path, f"frames[{i}].file_path", f"{file_path!r}, which is not there", "an image file")
        width, height, _ = image_header(file)
        focal = checks.field_of_view(path, "camera_angle_x", angle, width)
        shots.append(Shot(file_path, file, c2w, Optics(width, height, focal, focal, width / 2, height / 2)))
    checks.told_apart(path, np.stack([shot.c2w for shot in shots]), np.array([shot.optics.fx for shot in shots]))
    return read_shots(path, shots, Reading(resize))
