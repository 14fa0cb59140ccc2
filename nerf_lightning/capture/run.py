"""From two folders of photos to a scene file and the files beside it."""

import importlib.util
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.photos import find_wrong_sizes
from nerf_lightning.capture.poses.calibrate import Calibration, calibrate, drop_tag, reprojection_message
from nerf_lightning.capture.poses.geometry import inverse
from nerf_lightning.capture.poses.solve import Pose, Solved, misfits, solve
from nerf_lightning.capture.poses.texture import HINT, place_by_texture
from nerf_lightning.capture.tags.board import Board, board_detector
from nerf_lightning.capture.tags.detect import Sighting, detect_in_photos, guess_family, tag_detector
from nerf_lightning.capture.tags.layout import read_layout
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.placing.photos import find_photos
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import atomic, write_json

log = logging.getLogger(__name__)

MIN_DISTANCE_M, MAX_DISTANCE_M = 0.03, 30.0
"""Plausible median distance of cameras from tags; others mean that the size was given in another unit."""


@dataclass(frozen=True)
class PlacedPhoto:
    """A photo with its camera, or the reason why it has none."""

    name: str
    reason: str = ""
    """Why it was left out; "" if it was placed."""
    c2w: Float[np.ndarray, "4 4"] | None = None
    """OpenCV frame, metres."""
    reprojection_px: float | None = None
    by: str = ""
    """"texture" if it shows no tag, and was placed against the photos that do; "" if as the others."""


@dataclass(frozen=True)
class Capture:
    """All results, for the report."""

    calibration: Calibration
    sightings: list[Sighting]
    """Of the photos to be placed that have the calibrated size."""
    solved: Solved
    photos: list[PlacedPhoto]
    scene: Scene


def capture_scene(
    calibration: Path,
    photos: Path,
    tag_size: float,
    output: Path,
    *,
    dictionary: str = "auto",
    layout: Path | None = None,
    board: Board | None = None,
    longest: int | None = 300,
    holdout: int = 10,
) -> Capture:
    """Calibrates, places the photos, and writes the scene, `cameras.json` and `calibration.yaml`; see `command.capture`.

    Args:
        calibration, photos, tag_size, output, dictionary, layout, holdout: see there.
        board: a ChArUco board instead of tags on their own.
        longest: side of the scene's photos in pixels; None keeps their size.

    Raises:
        InputError: the options or photos are no good.
    """
    sheets, views = find_photos(calibration, "calibration"), find_photos(photos, "photos")
    family = guess_family(sheets) if dictionary == "auto" else dictionary
    known = None if layout is None or board else read_layout(layout, family, tag_size).poses
    detector = board_detector(family, tag_size, board) if board else tag_detector(family, tag_size)
    log.info("looking for tags of %s in %s and %s", family, calibration, photos)
    of_sheet, of_views = detect_in_photos(sheets, detector), detect_in_photos(views, detector)
    wrong = find_wrong_sizes(calibration, of_sheet)
    of_sheet = [s for s in of_sheet if s.name not in wrong]
    reasons = find_wrong_sizes(photos, of_views, (of_sheet[0].width, of_sheet[0].height))
    usable = [s for s in of_views if s.name not in reasons]
    if not any(s.marks for s in usable):
        raise InputError(
            photos,
            "",
            f"no tag of {family} in {len(usable)} photos",
            "photos with at least one whole tag in view",
            "are the folders swapped, or is the dictionary another one?",
        )
    found = calibrate(calibration, of_sheet, known)
    found.dropped.update(wrong)
    _log(found)
    solved, left_out = place_by_tags(usable, found.lens, known)
    _check_distance(solved, photos, tag_size)
    textured, still_left_out = _place_untagged(usable, found.lens, solved, left_out)
    placed = {photo.name: photo for photo in [*_placed_by_tags(usable, solved), *textured]}
    reasons |= still_left_out
    results = [placed.get(s.name) or PlacedPhoto(s.name, reasons[s.name]) for s in of_views]
    for photo in results:
        if photo.c2w is None:
            log.warning("%s left out: %s", photo.name, photo.reason)
    c2w = {photos / photo.name: photo.c2w for photo in results if photo.c2w is not None}
    scene = pack(list(c2w), np.stack(list(c2w.values())), found.lens, output.stem, str(photos), longest, holdout)
    save_npz(scene, output)
    _write_cameras(output.with_name("cameras.json"), results, scene)
    tags = {"dictionary": family, "size": tag_size, "to_world": {tag: p.tolist() for tag, p in solved.tags.items()}}
    _write_calibration(output.with_name("calibration.yaml"), found, tags)
    return Capture(found, usable, solved, results, scene)


def place_by_tags(
    sightings: Sequence[Sighting], lens: Intrinsics, layout: dict[int, Pose] | None
) -> tuple[Solved, dict[str, str]]:
    """Places photos; leaves out those without tags and those that contradict the others.

    Returns:
        Tags and cameras, and why each photo that was left out was, by name.

    Raises:
        InputError: no photo can be placed.
    """
    reasons = {s.name: "no tag found" for s in sightings if not s.marks}
    left = list(sightings)
    while True:
        solved = solve(lens, [{} if s.name in reasons else s.marks for s in left], layout)
        if solved is None:
            raise InputError(
                sightings[0].path.parent, "", "tags that fit no camera", "photos of flat tags, of the size given"
            )
        off = misfits(solved)
        if not off.photos and not off.marks:
            unlinked = {s.name for i, s in enumerate(sightings) if i not in solved.w2c} - set(reasons)
            return solved, reasons | dict.fromkeys(unlinked, "its tags are not linked to those of the other photos")
        reasons |= {sightings[i].name: reprojection_message(error, off.usual) for i, error in off.photos.items()}
        left = [drop_tag(s, off.marks.get(i)) for i, s in enumerate(left)]


def _placed_by_tags(sightings: Sequence[Sighting], solved: Solved) -> list[PlacedPhoto]:
    return [
        PlacedPhoto(sightings[i].name, "", inverse(solved.w2c[i]), float(rms))
        for i, rms in zip(solved.placed, solved.refined.rms, strict=True)
    ]


def _place_untagged(
    sightings: Sequence[Sighting], lens: Intrinsics, solved: Solved, reasons: dict[str, str]
) -> tuple[list[PlacedPhoto], dict[str, str]]:
    """Places photos without tags by their texture, and tells why each that is still left out is."""
    untagged = [s.name for s in sightings if not s.marks]
    if not untagged:
        return [], reasons
    if importlib.util.find_spec("pycolmap") is None:
        return [], reasons | {name: reasons[name] + HINT for name in untagged}
    known = {sightings[i].name: pose for i, pose in solved.w2c.items()}
    found, lost = place_by_texture([s.path for s in sightings], lens, known, untagged)
    placed = [PlacedPhoto(name, "", inverse(f.w2c), f.reprojection_px, "texture") for name, f in found.items()]
    return placed, reasons | lost


def _check_distance(solved: Solved, photos: Path, tag_size: float) -> None:
    distance = float(np.median([np.linalg.norm(inverse(w2c)[:3, 3]) for w2c in solved.w2c.values()]))
    if not MIN_DISTANCE_M < distance < MAX_DISTANCE_M:
        raise InputError(
            "capture",
            "tag_size",
            f"{tag_size:g}, which puts the cameras of {photos} {distance:.3g} m away from the tags",
            f"{MIN_DISTANCE_M} to {MAX_DISTANCE_M:g} m",
            "give the side of the black square in metres: 6 cm are 0.06",
        )


def _log(found: Calibration) -> None:
    for text in found.warnings:
        log.warning("calibration: %s", text)
    for name, reason in found.dropped.items():
        log.warning("%s left out of the calibration: %s", name, reason)
    log.info("focal length %.1f pixels, reprojection error %.2f pixels", found.lens.fx, found.rms)


def _write_cameras(file: Path, photos: Sequence[PlacedPhoto], scene: Scene) -> None:
    K = scene.train.cameras.K[0].tolist()  # of the undistorted, resized photos
    entries = [
        {
            "name": photo.name,
            "status": "left out" if photo.c2w is None else "placed",
            "reason": photo.reason,
            "K": None if photo.c2w is None else K,
            "c2w": None if photo.c2w is None else photo.c2w.tolist(),
            "reprojection_px": photo.reprojection_px,
            **({"by": photo.by} if photo.by else {}),
        }
        for photo in photos
    ]
    write_json(file, {"photos": entries})


def _write_calibration(file: Path, found: Calibration, tags: dict[str, Any]) -> None:
    lens = found.lens
    content = {
        **{key: getattr(lens, key) for key in ("width", "height")},
        **{key: float(getattr(lens, key)) for key in ("fx", "fy", "cx", "cy")},
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), map(float, lens.opencv), strict=True)),
        "standard_deviations": found.deviations,
        "reprojection_px": found.rms,
        "photos_used": [s.name for s in found.used],
        "photos_left_out": found.dropped,
        "coverage": found.coverage,
        "largest_tilt_degrees": float(np.degrees(found.tilt)),
        "warnings": found.warnings,
        "tags": tags,
    }
    with atomic(file) as temporary:
        temporary.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")
