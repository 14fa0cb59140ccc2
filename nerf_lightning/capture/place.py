"""Where the photos of the subject were taken: by the tags they show, or by their texture."""

import importlib.util
import logging
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nerf_lightning.capture.poses.geometry import inverse
from nerf_lightning.capture.poses.pose import Pose
from nerf_lightning.capture.poses.solve import PlacedPhoto, Solved, solve, solve_without_misfits
from nerf_lightning.capture.tags.detect import Sighting, find_wrong_sizes
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.sfm.colmap import register
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)


def place_photos(
    folder: Path, sightings: Sequence[Sighting], lens: Intrinsics, layout: dict[int, Pose] | None
) -> tuple[Solved, list[PlacedPhoto]]:
    """Places the photos of the subject. Those of another size than the lens's, those that contradict the others, and those
    that show neither tags nor enough texture are left out.

    Args:
        folder: where the photos are, for messages.
        sightings: all photos, in the order taken.
        lens: calibrated.
        layout: tag to world; None solves it from these photos.

    Returns:
        The cameras and tags that were solved for, and all photos.

    Raises:
        InputError: no photo shows a tag, or none can be placed.
    """
    wrong = find_wrong_sizes(folder, sightings, (lens.width, lens.height))
    if not any(s.marks for s in sightings if s.name not in wrong):
        found = f"no tag in {len(sightings) - len(wrong)} photos"
        advice = "are the folders swapped, or is the dictionary another one?"
        raise InputError(folder, "", found, "photos with at least one whole tag in view", advice)
    solved, photos = solve_without_misfits(sightings, wrong, lambda left: solve(lens, left, layout))
    untagged = [photo for photo in photos if photo.name not in wrong and not photo.sighting.marks]
    if not untagged:
        return solved, photos
    if importlib.util.find_spec("pycolmap") is None:
        hint = "no tag found; pip install 'nerf_lightning[colmap]' places such photos by their texture"
        placed = {photo.name: replace(photo, reason=hint) for photo in untagged}
    else:
        log.info("placing %d photos without tags by their texture", len(untagged))
        names = {photo.name for photo in untagged}
        usable = [photo for photo in photos if photo.c2w is not None or photo.name in names]
        placed = {photo.name: photo for photo in place_untagged(lens, usable)}
    return solved, [placed.get(photo.name, photo) for photo in photos]


def place_untagged(lens: Intrinsics, photos: Sequence[PlacedPhoto]) -> list[PlacedPhoto]:
    """Places photos by their texture against those that tags have placed; or says that they cannot be."""
    known = {number: inverse(photo.c2w) for number, photo in enumerate(photos) if photo.c2w is not None}
    with tempfile.TemporaryDirectory() as workspace:
        found = register([photo.sighting.path for photo in photos], lens, known, Path(workspace))
    placed = []
    for number, photo in enumerate(photos):
        if number in found:
            w2c, error = found[number]
            placed.append(replace(photo, reason="", c2w=inverse(w2c), reprojection_px=error, by="texture"))
        elif photo.c2w is None:
            reason = "no tag found, and too few points of its texture agree with the other photos"
            placed.append(replace(photo, reason=reason))
    return placed
