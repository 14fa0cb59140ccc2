"""Registers the photos of the subject: by the tags they show, or by their texture."""

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
    """Registers the photos of the subject, except those of the wrong size, outliers, and those without tags or texture.

    Args:
        folder: of the photos, for messages.
        observations: all photos, in the order taken.
        lens: calibrated.
        layout: tag to world; None solves it from these photos.

    Returns:
        The solved cameras and tags, and all photos.

    Raises:
        InputError: no photo shows a tag, or none can be registered.
    """
    exclusions = find_wrong_sizes(folder, observations, (lens.width, lens.height))
    if not any(s.detections for s in observations if s.name not in exclusions):
        problem = f"no tag in {len(observations) - len(exclusions)} photos"
        advice = "are the folders swapped, or is the dictionary wrong?"
        raise InputError(folder, "", problem, hint=advice)
    solution, photos = solve_without_outliers(observations, exclusions, lambda left: solve_poses(lens, left, layout))
    untagged = [photo for photo in photos if photo.name not in exclusions and not photo.observation.detections]
    if not untagged:
        return solution, photos
    if importlib.util.find_spec("pycolmap") is None:
        hint = "no tag found; pip install 'nerf_lightning[colmap]' registers such photos by their texture"
        registered = {photo.name: replace(photo, reason=hint) for photo in untagged}
    else:
        log.info("registering %d photos without tags by their texture", len(untagged))
        untagged_names = {photo.name for photo in untagged}
        usable = [photo for photo in photos if photo.c2w is not None or photo.name in untagged_names]
        registered = {photo.name: photo for photo in register_untagged(lens, usable)}
    return solution, [registered.get(photo.name, photo) for photo in photos]


def register_untagged(lens: Intrinsics, photos: Sequence[RegisteredPhoto]) -> list[RegisteredPhoto]:
    """Registers photos by their texture against those with tags; the others get a reason."""
    known = {number: invert_pose(photo.c2w) for number, photo in enumerate(photos) if photo.c2w is not None}
    with tempfile.TemporaryDirectory() as workspace:
        poses = register_with_known_poses([photo.observation.path for photo in photos], lens, known, Path(workspace))
    registered = []
    for number, photo in enumerate(photos):
        if number in poses:
            w2c, error = poses[number]
            registered.append(replace(photo, reason="", c2w=invert_pose(w2c), reprojection_px=error, method="texture"))
        elif photo.c2w is None:
            reason = "no tag found, and too few features match the other photos"
            registered.append(replace(photo, reason=reason))
    return registered
