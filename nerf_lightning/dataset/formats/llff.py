"""LLFF format (Mildenhall et al. 2019): poses_bounds.npy and a folder of photos."""

from pathlib import Path

import numpy as np

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.file_names import list_images
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.orientation import choose_orientations
from nerf_lightning.dataset.photo_loading import DEFAULT_OPTIONS, PhotoLoadOptions, PosedPhoto
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_builder import Hints, build_scene
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_npy

POSES_FILE = "poses_bounds.npy"
PHOTO_FOLDERS = ("images", "images_2", "images_4", "images_8", "")


def load_llff(folder: Path, name: str | None = None, options: PhotoLoadOptions = DEFAULT_OPTIONS) -> Scene:
    """Reads poses_bounds.npy and its photos, sorted by name.

    A row has a pose of 3 x 5 numbers (rotation with columns down, right, backward; center; height, width and focal length in
    pixels), then the nearest and farthest depth.

    Args:
        folder: folder of poses_bounds.npy and `images`, or of reduced photos in `images_2`, `images_4` or `images_8`.
        name: defaults to the folder's name.
        options: how to read photos.

    Raises:
        InputError: a damaged file, or different numbers of photos and poses.
    """
    path = folder / POSES_FILE
    rows = checks.parse_floats(path, "", read_npy(path))
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise InputError(path, "", f"shape {rows.shape}", "numbers of shape (photos, 17)")
    columns = rows[:, :15].reshape(-1, 3, 5)
    c2w = np.tile(np.eye(4), (len(rows), 1, 1))
    c2w[:, :3] = columns[:, :, [1, 0, 2, 3]] * [1, 1, -1, 1]
    c2w = checks.check_poses(path, "row {}", c2w)
    photos = find_llff_photos(folder, len(rows))
    cameras = []
    for photo, (height, width, focal) in zip(photos, columns[:, :, 4].tolist(), strict=True):
        width, height, focal = checks.parse_array(path, photo.name, [width, height, focal], 3).tolist()
        intrinsics = Intrinsics(round(width), round(height), focal, focal, width / 2, height / 2)
        cameras.append(checks.check_camera(path, photo.name, intrinsics))
    sizes = [(camera.width, camera.height) for camera in cameras]
    upright = choose_orientations(folder, photos, sizes, options.orientation)
    parts = zip(photos, c2w, cameras, find_masks(photos, folder), upright, strict=True)
    posed_photos = [PosedPhoto(photo.name, photo, *rest) for photo, *rest in parts]
    nearest = float(rows[:, 15].min())
    hints = Hints(nearest_depth=nearest if 0 < nearest <= checks.MAX_COORDINATE else None)
    return build_scene(folder, name or folder.resolve().name, posed_photos, options, hints=hints)


def find_llff_photos(folder: Path, count: int) -> list[Path]:
    """Finds the photo folder with camera photo per pose, sorted by name."""
    found = {name or ".": list_images(folder / name) for name in PHOTO_FOLDERS if (folder / name).is_dir()}
    for files in found.values():
        if len(files) == count:
            return files
    shown = ", ".join(f"{len(files)} in {name}" for name, files in found.items() if files) or "no photos"
    raise InputError(folder / POSES_FILE, "", f"{count} poses, but {shown}", "one pose per photo of the folder images")
