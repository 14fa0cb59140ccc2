"""Photos without tags: COLMAP finds lens and cameras from the photos' own texture (structure from motion)."""

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from nerf_lightning.capture.outputs import Packing, Placed, write_scene
from nerf_lightning.capture.photos import of_one_size
from nerf_lightning.capture.poses.geometry import inverse
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.dataset.placing.photos import find_photos
from nerf_lightning.dataset.placing.place import FEWEST, OVERLAP, place
from nerf_lightning.dataset.posed import normalize_poses
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError

if TYPE_CHECKING:
    import pycolmap


def capture_without_tags(folder: Path, packing: Packing) -> tuple[list[Placed], Scene]:
    """Places photos by structure from motion (see `place`), and writes what `capture` writes.

    Photos do not tell the scale: the unit is the cameras' median distance to what they look at, which is the origin. z points
    up, as far as the photos were held level.

    Args:
        folder: of photos taken with one camera without zooming; others are left out.
        packing: the scene to write.

    Raises:
        InputError: pycolmap is not installed, or the photos do not hang together.
    """
    paths = find_photos(folder, "photos")
    packing.check(paths)
    model = _model(place(folder))
    images = {image.name: image for image in model.images.values() if image.has_pose}
    others = _others(folder, images, model)
    names = [path.name for path in paths if path.name in images and path.name not in others]
    if len(names) < FEWEST:
        found = f"{len(names)} of {len(paths)} photos of one size and zoom that hang together"
        raise InputError(folder, "", found, f"at least {FEWEST}", OVERLAP)
    lens = _lens(model.cameras[images[names[0]].camera_id])
    last = [[0.0, 0.0, 0.0, 1.0]]
    raw = np.stack([inverse(np.concatenate([images[name].cam_from_world().matrix(), last])) for name in names])
    points = np.array([point.xyz for point in model.points3D.values()]).reshape(-1, 3)
    region = find_region(torch.from_numpy(raw), torch.from_numpy(points))
    placed, _ = normalize_poses(torch.from_numpy(raw), torch.arange(len(raw)), region)
    poses = dict(zip(names, placed.numpy(), strict=True))
    photos = []
    for path in paths:
        if path.name in poses:
            photos.append(Placed(path.name, "", poses[path.name], _error(images[path.name], model)))
        else:
            reason = others.get(path.name, "it shares too few points with the other photos")
            photos.append(Placed(path.name, reason))
    errors = [photo.reprojection_px for photo in photos if photo.reprojection_px]
    details = {
        "reprojection_px": float(np.sqrt(np.mean(np.square(errors)))),
        "photos_used": names,
        "photos_left_out": {photo.name: photo.reason for photo in photos if photo.reason},
        "unit": "the cameras' median distance to what they look at",
    }
    return photos, write_scene(folder, photos, lens, packing, details)


def _model(folder: Path) -> "pycolmap.Reconstruction":
    import pycolmap

    return pycolmap.Reconstruction(folder)


def _others(folder: Path, images: "dict[str, pycolmap.Image]", model: "pycolmap.Reconstruction") -> dict[str, str]:
    """Placed photos that were not taken as most were, and what is different: a scene has one lens."""
    cameras = {name: model.cameras[image.camera_id] for name, image in images.items()}
    others = of_one_size(folder, {name: (camera.width, camera.height) for name, camera in cameras.items()})
    numbers = {name: camera.camera_id for name, camera in cameras.items() if name not in others}
    most = Counter(numbers.values()).most_common(1)[0][0]
    zoomed = {name: "taken with another camera or zoom than most" for name, n in numbers.items() if n != most}
    return others | zoomed


def _lens(camera: "pycolmap.Camera") -> Lens:
    """COLMAP's pixel centres are at +0.5, as ours are."""
    if camera.model_name == "OPENCV":
        fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
        return Lens(camera.width, camera.height, fx, fy, cx, cy, (k1, k2, p1, p2, 0.0))
    f, cx, cy, k1 = camera.params  # SIMPLE_RADIAL
    return Lens(camera.width, camera.height, f, f, cx, cy, (k1, 0.0, 0.0, 0.0, 0.0))


def _error(image: "pycolmap.Image", model: "pycolmap.Reconstruction") -> float:
    """Root mean square reprojection distance of a photo's points, pixels."""
    squares = []
    for point in image.points2D:
        if point.has_point3D():
            seen = image.project_point(model.points3D[point.point3D_id].xyz)
            if seen is not None:
                squares.append(float(((seen - point.xy) ** 2).sum()))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0
