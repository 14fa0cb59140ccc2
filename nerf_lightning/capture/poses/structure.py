"""Photos without tags: COLMAP finds lens and cameras from the photos' own texture (structure from motion)."""

import importlib.util
import logging
import tempfile
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import imageio.v3 as imageio
import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import focus_point
from nerf_lightning.capture.outputs import Packing, Placed, write_scene
from nerf_lightning.capture.photos import find_photos, of_one_size
from nerf_lightning.capture.poses.geometry import inverse
from nerf_lightning.dataset.extent import viewing_distance
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError
from nerf_lightning.utils.progress import tracked

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

SIDE = 1600
"""Longest side in pixels of the copies in which COLMAP looks for features."""
FEWEST = 3
"""Placed photos that make a result."""
OVERLAP = "take more photos, in small steps around the subject, sharp, of something with texture; or use tags"


def capture_without_tags(folder: Path, packing: Packing) -> tuple[list[Placed], Scene]:
    """Places photos by structure from motion (Schoenberger and Frahm 2016), and writes what `capture` writes.

    Photos do not tell the scale: the unit is the cameras' median distance to what they look at, which is the origin. z points
    up, as far as the photos were held level.

    Args:
        folder: of photos taken with one camera without zooming.
        packing: the scene to write.

    Raises:
        InputError: pycolmap is not installed, or the photos do not hang together.
    """
    if importlib.util.find_spec("pycolmap") is None:
        todo = "pip install 'nerf_lightning[colmap]'"
        raise InputError("pycolmap", "", "no such package", "the optional extra for photos without tags", todo)
    paths = find_photos(folder, "photos")
    packing.check(paths)
    with tempfile.TemporaryDirectory() as workspace:
        sizes = _copies(paths, Path(workspace) / "photos")
        turned = of_one_size(folder, sizes)
        usable = [path for path in paths if path.name not in turned]
        model = _reconstruct(Path(workspace), [f"{paths.index(path):06d}.png" for path in usable])
    if model is None or model.num_reg_images() < FEWEST:
        found = f"{0 if model is None else model.num_reg_images()} of {len(usable)} photos that hang together"
        raise InputError(folder, "", found, f"at least {FEWEST}", OVERLAP)
    width, height = Counter(sizes[path.name] for path in usable).most_common(1)[0][0]
    lens = _lens(model, width, height)
    scale = width / next(iter(model.cameras.values())).width
    images = {image.name: image for image in model.images.values() if image.has_pose}
    numbers = {path.name: f"{number:06d}.png" for number, path in enumerate(paths)}
    names = [path.name for path in usable if numbers[path.name] in images]
    last = [[0.0, 0.0, 0.0, 1.0]]
    raw = np.stack([inverse(np.concatenate([images[numbers[name]].cam_from_world().matrix(), last])) for name in names])
    poses = dict(zip(names, upright(raw), strict=True))
    photos = []
    for path in paths:
        if path.name in poses:
            error = _error(images[numbers[path.name]], model) * scale
            photos.append(Placed(path.name, "", poses[path.name], error))
        else:
            reason = turned.get(path.name, "it shares too few points with the other photos")
            photos.append(Placed(path.name, reason))
    errors = [photo.reprojection_px for photo in photos if photo.reprojection_px]
    details = {
        "reprojection_px": float(np.sqrt(np.mean(np.square(errors)))),
        "photos_used": names,
        "photos_left_out": {photo.name: photo.reason for photo in photos if photo.reason},
        "unit": "the cameras' median distance to what they look at",
    }
    return photos, write_scene(folder, photos, lens, packing, details)


def _copies(paths: list[Path], folder: Path) -> dict[str, tuple[int, int]]:
    """Writes upright copies of at most SIDE pixels, numbered, so that no file name matters; returns the photos' own sizes."""
    folder.mkdir()
    sizes = {}
    for number, path in tracked(enumerate(paths), len(paths), "reading photos"):
        photo = np.ascontiguousarray(read_pixels(path, upright=True)[..., :3])
        height, width = photo.shape[:2]
        sizes[path.name] = width, height
        small = cv2.resize(photo, fit_size(width, height, SIDE), interpolation=cv2.INTER_AREA)
        imageio.imwrite(folder / f"{number:06d}.png", small)
    return sizes


def _reconstruct(workspace: Path, names: list[str]) -> "pycolmap.Reconstruction | None":
    """The largest model that COLMAP makes of the copies; None where it makes none."""
    import pycolmap

    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(0)
    database, photos = workspace / "database.db", workspace / "photos"
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = "OPENCV"
    log.info("looking for features in %d photos", len(names))
    pycolmap.extract_features(database, photos, names, pycolmap.CameraMode.SINGLE, reader)
    log.info("matching them")
    pycolmap.match_exhaustive(database)
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = FEWEST
    options.random_seed = 0
    (workspace / "models").mkdir()
    log.info("placing them")
    models = pycolmap.incremental_mapping(database, photos, workspace / "models", options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def _lens(model: "pycolmap.Reconstruction", width: int, height: int) -> Lens:
    """The lens for photos of their own size; COLMAP's pixel centres are at +0.5 as ours are."""
    (camera,) = model.cameras.values()
    fx, fy, cx, cy, k1, k2, p1, p2 = camera.params
    x, y = width / camera.width, height / camera.height
    return Lens(width, height, fx * x, fy * y, cx * x, cy * y, (k1, k2, p1, p2, 0.0))


def _error(image: "pycolmap.Image", model: "pycolmap.Reconstruction") -> float:
    """Root mean square reprojection distance of a copy's points, in its pixels."""
    squares = []
    for point in image.points2D:
        if point.has_point3D():
            seen = image.project_point(model.points3D[point.point3D_id].xyz)
            if seen is not None:
                squares.append(float(((seen - point.xy) ** 2).sum()))
    return float(np.sqrt(np.mean(squares))) if squares else 0.0


def upright(c2w: Float[np.ndarray, "V 4 4"]) -> Float[np.ndarray, "V 4 4"]:
    """Poses in a frame with its origin where the cameras look, z up, at a median distance of 1.

    Up is the direction most nearly perpendicular to the photos' rows: people hold cameras level.
    """
    rows, downs = c2w[:, :3, 0], c2w[:, :3, 1]
    up = np.linalg.svd(rows)[2][2]
    up = -up if float(up @ downs.mean(0)) > 0 else up
    helper = np.eye(3)[np.abs(up).argmin()]
    x = np.cross(helper, up) / np.linalg.norm(np.cross(helper, up))
    turn = np.stack([x, np.cross(up, x), up])
    poses = torch.from_numpy(c2w)
    centre = focus_point(poses)
    out = c2w.copy()
    out[:, :3, :3] = turn @ c2w[:, :3, :3]
    out[:, :3, 3] = (c2w[:, :3, 3] - centre.numpy()) @ turn.T / viewing_distance(poses, centre)
    return out
