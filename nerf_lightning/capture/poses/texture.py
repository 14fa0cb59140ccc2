"""Photos that show no tag, placed by their texture against those that tags have placed (COLMAP)."""

import logging
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nerf_lightning.capture.poses.solve import Pose
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.placing.structure import SIDE, find_features, match_photos, write_copies
from nerf_lightning.dataset.resize import fit_size

if TYPE_CHECKING:
    import pycolmap

log = logging.getLogger(__name__)

MAX_ERROR_FRACTION = 0.004
"""Reprojection distance up to which a match holds, in longest sides: 4 pixels at 1000."""
MIN_POINTS = 15
"""That must agree on a pose: five times as many as determine one, so that chance matches do not."""
HINT = "; pip install 'nerf_lightning[colmap]' places such photos by their texture"


@dataclass(frozen=True)
class LocalizedPhoto:
    """A photo placed by its texture."""

    w2c: Pose
    reprojection_px: float
    """Root mean square over its points, pixels of the photo."""


def place_by_texture(
    paths: Sequence[Path], lens: Intrinsics, w2c: Mapping[str, Pose], untagged: Sequence[str]
) -> tuple[dict[str, LocalizedPhoto], dict[str, str]]:
    """Places photos against points that placed photos show; those and the lens stay as they are, and so do scale and frame.

    COLMAP matches features, triangulates points from the known poses and registers the other photos one after the other
    (Schoenberger and Frahm 2016, "Structure-from-motion revisited").

    Args:
        paths: of all photos of the lens.
        lens: calibrated.
        w2c: world to camera of the photos that are placed, by name.
        untagged: names of those to place.

    Returns:
        What was found, by name; and why the others were not placed.
    """
    import pycolmap

    log.info("placing %d photos without tags by their texture", len(untagged))
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    pycolmap.set_random_seed(0)
    width, height = fit_size(lens.width, lens.height, SIDE)
    x, y = width / lens.width, height / lens.height
    parameters = [lens.fx * x, lens.fy * y, lens.cx * x, lens.cy * y, *lens.opencv, 0.0, 0.0, 0.0]
    camera = pycolmap.Camera(model="FULL_OPENCV", width=width, height=height, params=parameters)
    camera.has_prior_focal_length = True
    names = {f"{number:06d}.png": path.name for number, path in enumerate(paths)}
    with tempfile.TemporaryDirectory() as workspace:
        folder = Path(workspace)
        copies, database, known, output = (folder / name for name in ("photos", "database.db", "known", "output"))
        known.mkdir()
        output.mkdir()
        write_copies(paths, [copies / name for name in names])
        with pycolmap.Database.open(database) as content:
            camera.camera_id = content.write_camera(camera)
        find_features(database, copies, {camera.camera_id: list(names)})
        match_photos(database, list(names), folder / "pairs.txt")
        options = _mapping_options(MAX_ERROR_FRACTION * max(width, height))
        start = _known_model(database, camera, {copy: w2c[name] for copy, name in names.items() if name in w2c})
        pycolmap.triangulate_points(start, database, copies, known, options=options).write_binary(known)
        models = pycolmap.incremental_mapping(database, copies, output, options, input_path=known)
    found = {}
    for model in models.values():
        for image in model.images.values():
            if names[image.name] in untagged and image.has_pose and image.num_points3D >= MIN_POINTS:
                pose = np.vstack([image.cam_from_world().matrix(), [0.0, 0.0, 0.0, 1.0]])
                found[names[image.name]] = LocalizedPhoto(pose, _reprojection_rms(image, model) / x)
    log.info("%d of them placed", len(found))
    reason = "no tag found, and too few points of its texture agree with the other photos"
    return found, {name: reason for name in untagged if name not in found}


def _mapping_options(max_error: float) -> "pycolmap.IncrementalPipelineOptions":
    """COLMAP's options: known poses and the lens are fixed, and matches hold up to an error in pixels."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = 0
    options.multiple_models = False
    options.fix_existing_frames = True
    options.ba_refine_focal_length = options.ba_refine_principal_point = options.ba_refine_extra_params = False
    options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    options.mapper.abs_pose_max_error = options.mapper.filter_max_reproj_error = max_error
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = max_error
    options.triangulation.ignore_two_view_tracks = False  # poses are known: two views tell where a point is
    return options


def _known_model(database: Path, camera: "pycolmap.Camera", w2c: Mapping[str, Pose]) -> "pycolmap.Reconstruction":
    """A model of the placed photos alone, without points; poses by the copy's name."""
    import pycolmap

    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with pycolmap.Database.open(database) as content:
        numbers = {image.name: image.image_id for image in content.read_all_images()}
    for name, pose in w2c.items():
        image = pycolmap.Image(name=name, camera_id=camera.camera_id, image_id=numbers[name])
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose[:3]))
    return model


def _reprojection_rms(image: "pycolmap.Image", model: "pycolmap.Reconstruction") -> float:
    """Over a photo's points, pixels of the copy."""
    points = [point for point in image.points2D if point.has_point3D()]
    projected = [image.project_point(model.points3D[point.point3D_id].xyz) for point in points]
    squares = [((p - point.xy) ** 2).sum() for p, point in zip(projected, points, strict=True) if p is not None]
    return float(np.sqrt(np.mean(squares)))
