"""The LLFF format (Mildenhall et al. 2019): poses_bounds.npy beside a folder of photos."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.names import list_images
from nerf_lightning.dataset.masks import find_masks
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.dataset.orientation import OrientationChooser
from nerf_lightning.dataset.posed import Hints, build_scene
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.shots import AS_IT_IS, Reading, Shot
from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import Header, read_npy

POSES = "poses_bounds.npy"


def load_llff(folder: Path, name: str | None = None, reading: Reading = AS_IT_IS) -> Scene:
    """Reads poses_bounds.npy and the photos beside it, in the order of their names.

    A row holds a pose of 3 x 5 numbers (rotation with columns down, right, backward; centre; height, width and focal length in
    pixels), then the nearest and farthest depth.

    Args:
        folder: holds poses_bounds.npy and `images`, or photos of another size in `images_2`, `images_4` or `images_8`.
        name: defaults to the folder's name.
        reading: see there.

    Raises:
        InputError: a damaged file, or as many photos as poses are not there.
    """
    path = folder / POSES
    c2w, sizes, nearest = _rows(path)
    photos = _photos(folder, len(c2w))
    masks = find_masks(photos, folder)
    orientation = OrientationChooser(reading.orientation)
    shots = []
    for photo, mask, pose, (height, width, focal) in zip(photos, masks, c2w, sizes.tolist(), strict=True):
        optics = Optics(round(width), round(height), focal, focal, width / 2, height / 2)
        upright = orientation.choose(photo, (optics.width, optics.height))[2]
        shots.append(
            Shot(photo.name, photo, pose, checks.check_optics(folder / POSES, photo.name, optics), mask, upright)
        )
    orientation.report(folder)
    return build_scene(folder, name or folder.resolve().name, shots, reading, hints=Hints(nearest=nearest))


def _rows(path: Path) -> tuple[Float[np.ndarray, "V 4 4"], Float[np.ndarray, "V 3"], float | None]:
    """Poses, OpenCV camera to world; height, width and focal length; and the least depth, if it is one."""

    def check(header: Header) -> None:
        if header.shape[1:] != (17,) or header.dtype.kind not in "iuf":
            raise InputError(path, "", f"shape {header.shape}, {header.dtype}", "numbers of shape (photos, 17)")

    rows = read_npy(path, check)
    poses = rows[:, :15].astype(np.float64).reshape(-1, 3, 5)
    c2w = np.zeros((len(poses), 4, 4))
    c2w[:, :3, 0], c2w[:, :3, 1] = poses[:, :, 1], poses[:, :, 0]
    c2w[:, :3, 2], c2w[:, :3, 3] = -poses[:, :, 2], poses[:, :, 3]
    c2w[:, 3, 3] = 1
    sizes = poses[:, :, 4]
    if not len(poses):
        raise InputError(path, "", "no photo", "a row for each")
    if (wrong := ~((sizes[:, :2] >= 1) & (sizes[:, :2] <= checks.PIXELS)).all(1)).any():
        raise InputError(
            path, f"row {wrong.argmax()}", str(sizes[wrong.argmax()].tolist()), "height, width, focal length"
        )
    nearest = float(rows[:, 15].min())
    return checks.rigid_poses(path, "row {}", c2w), sizes, nearest if 0 < nearest <= checks.FARTHEST else None


def _photos(folder: Path, count: int) -> list[Path]:
    """As many photos as there are poses, in the order of their names."""
    names = ("images", "images_2", "images_4", "images_8", "")
    found = {}
    for name in names:
        below = folder / name
        files = list_images(below) if below.is_dir() else []
        if len(files) == count:
            return files
        if files:
            found[name or "."] = len(files)
    shown = ", ".join(f"{number} in {name}" for name, number in found.items()) or "no photos"
    raise InputError(folder / POSES, "", f"{count} poses, but {shown}", "a pose for each photo of the folder images")
