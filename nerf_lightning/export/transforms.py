"""Export of posed photos as a nerfstudio dataset: transforms.json, images and masks."""

from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np

from nerf_lightning.cameras import Distortion, Projection, transform_poses
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.dataset.formats.transforms_json import opengl_to_opencv
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.progress import track_progress

LENS_COEFFICIENTS = {
    Projection.PERSPECTIVE: ("k1", "k2", "k3", "p1", "p2"),
    Projection.FISHEYE: ("k1", "k2", "k3", "k4"),
}
"""Distortion coefficients supported by the format."""


def write_photos(scene: Scene, folder: Path) -> None:
    """Writes the photos of a scene as PNGs below `images/`, masks below `masks/`, and `transforms.json`.

    Poses are OpenGL cameras in the dataset's frame and unit; the split is stored.

    Raises:
        InputError: the format does not support a lens.
    """
    parts = {"train_filenames": scene.train, "val_filenames": scene.val}
    if scene.test is not None:
        parts["test_filenames"] = scene.test
    stems = [Path(views.name(view)).stem for views in parts.values() for view in range(len(views))]
    if len(set(stems)) < len(stems):
        stems = [f"{number:04d}" for number in range(len(stems))]
    content: dict[str, Any] = {"frames": []}
    named = iter(track_progress(stems, len(stems), "writing photos"))
    for key, views in parts.items():
        poses = opengl_to_opencv(transform_poses(views.cameras.c2w, scene.to_source).numpy())  # its own inverse
        content[key] = []
        for view in range(len(views)):
            stem = next(named)
            frame = {"file_path": f"images/{stem}.png", "transform_matrix": poses[view].tolist()}
            write_picture(folder / frame["file_path"], views.image(view).numpy())
            if views.valid_mask is not None:
                frame["mask_path"] = f"masks/{stem}.png"
                write_picture(folder / frame["mask_path"], views.view_mask(view).numpy().astype(np.uint8) * 255)
            content[key].append(frame["file_path"])
            content["frames"].append(frame | describe_intrinsics(views, view))
    write_json(folder / "transforms.json", content)


def write_picture(path: Path, picture: np.ndarray) -> None:
    """Writes an image; creates its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    imageio.imwrite(path, picture)


def describe_intrinsics(views: Views, view: int) -> dict[str, Any]:
    """Intrinsics and distortion of a view, by the format's keys."""
    K, (width, height) = views.cameras.K[view].tolist(), views.cameras.size(view)
    intrinsics = {"w": width, "h": height, "fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    lenses = views.cameras.lenses
    if lenses is None:
        return {"camera_model": "PINHOLE", **intrinsics}
    projection = Projection(int(lenses.projection[view]))
    if projection == Projection.EQUIRECTANGULAR:
        # nerfstudio expects the height as both focal lengths.
        return {"camera_model": "EQUIRECTANGULAR", **intrinsics, "fl_x": height, "fl_y": height}
    lens = Distortion(*lenses.coefficients[view].tolist())._asdict()
    if unknown := [name for name, value in lens.items() if value and name not in LENS_COEFFICIENTS[projection]]:
        expected = f"at most {', '.join(LENS_COEFFICIENTS[projection])}, as transforms.json knows"
        raise InputError(views.name(view), unknown[0], f"{lens[unknown[0]]:g}", expected)
    model = "OPENCV_FISHEYE" if projection == Projection.FISHEYE else "OPENCV"
    return {"camera_model": model, **intrinsics, **{name: lens[name] for name in LENS_COEFFICIENTS[projection]}}
