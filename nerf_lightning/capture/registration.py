"""Where the photos of the subject were taken: by the tags they show, or by their texture."""

import importlib.util
import logging
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nerf_lightning.capture.poses.geometry import invert_pose
from nerf_lightning.capture.poses.planar_pnp import Pose
from nerf_lightning.capture.poses.pose_solver import PoseSolution, RegisteredPhoto, solve_poses, solve_without_outliers
from nerf_lightning.capture.tags.detect import PhotoObservation, find_wrong_sizes
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.sfm.colmap import register_with_known_poses
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)


def register_photos(
    folder: Path, observations: Sequence[PhotoObservation], lens: Intrinsics, layout: dict[int, Pose] | None
) -> tuple[PoseSolution, list[RegisteredPhoto]]:
    """Places the photos of the subject. Those of another size than the lens's, those that contradict the others, and those
    that show neither tags nor enough texture are left out.

    Args:
        folder: where the photos are, for messages.
        observations: all photos, in the order taken.
        lens: calibrated.
        layout: tag to world; None solves it from these photos.

    Returns:
        The cameras and tags that were solved for, and all photos.

    Raises:
        InputError: no photo shows a tag, or none can be placed.
    """
    exclusions = find_wrong_sizes(folder, observations, (lens.width, lens.height))
    if not any(s.detections for s in observations if s.name not in exclusions):
        found = f"no tag in {len(observations) - len(exclusions)} photos"
        advice = "are the folders swapped, or is the dictionary another one?"
        raise InputError(folder, "", found, hint=advice)
    solution, photos = solve_without_outliers(observations, exclusions, lambda left: solve_poses(lens, left, layout))
    untagged = [photo for photo in photos if photo.name not in exclusions and not photo.observation.detections]
    if not untagged:
        return solution, photos
    if importlib.util.find_spec("pycolmap") is None:
        hint = "no tag found; pip install 'nerf_lightning[colmap]' places such photos by their texture"
        registered = {photo.name: replace(photo, reason=hint) for photo in untagged}
    else:
        log.info("placing %d photos without tags by their texture", len(untagged))
        untagged_names = {photo.name for photo in untagged}
        usable = [photo for photo in photos if photo.c2w is not None or photo.name in untagged_names]
        registered = {photo.name: photo for photo in register_untagged(lens, usable)}
    return solution, [registered.get(photo.name, photo) for photo in photos]


def register_untagged(lens: Intrinsics, photos: Sequence[RegisteredPhoto]) -> list[RegisteredPhoto]:
    """Places photos by their texture against those that tags have placed; or says that they cannot be."""
    known = {number: invert_pose(photo.c2w) for number, photo in enumerate(photos) if photo.c2w is not None}
    with tempfile.TemporaryDirectory() as workspace:
        poses = register_with_known_poses([photo.observation.path for photo in photos], lens, known, Path(workspace))
    registered = []
    for number, photo in enumerate(photos):
        if number in poses:
            w2c, error = poses[number]
            registered.append(replace(photo, reason="", c2w=invert_pose(w2c), reprojection_px=error, method="texture"))
        elif photo.c2w is None:
            reason = "no tag found, and too few points of its texture agree with the other photos"
            registered.append(replace(photo, reason=reason))
    return registered
