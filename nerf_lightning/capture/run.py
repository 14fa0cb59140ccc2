"""From two folders of photos to a scene file and the files beside it."""

import importlib.util
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nerf_lightning.capture.outputs import Packing, Placed, write_scene
from nerf_lightning.capture.photos import of_one_size
from nerf_lightning.capture.poses.calibrate import Calibration, calibrate, off_by, without
from nerf_lightning.capture.poses.geometry import inverse
from nerf_lightning.capture.poses.solve import Solved, misfits, solve
from nerf_lightning.capture.poses.texture import HINT, place_by_texture
from nerf_lightning.capture.tags.board import Board, board_detector
from nerf_lightning.capture.tags.detect import Sighting, guess_family, sight, tag_detector
from nerf_lightning.capture.tags.layout import read_layout
from nerf_lightning.dataset.placing.photos import find_photos
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

NEAREST, FARTHEST = 0.03, 30.0
"""Plausible distances of cameras from tags, metres; others mean that the size was given in another unit."""


@dataclass(frozen=True)
class Capture:
    """All results, for the report."""

    calibration: Calibration
    sightings: list[Sighting]
    """Of the photos to be placed that have the calibrated size."""
    solved: Solved
    photos: list[Placed]
    scene: Scene


def capture(
    calibration: Path,
    photos: Path,
    size: float,
    packing: Packing,
    dictionary: str = "auto",
    layout: str = "auto",
    board: Board | None = None,
) -> Capture:
    """Calibrates, places the photos, and writes the scene, `cameras.json` and `calibration.yaml` beside it.

    Args:
        calibration: folder of photos of the tags.
        photos: folder of photos of the subject, with tags in view.
        size: side of a tag's black square, metres.
        packing: the scene to write.
        dictionary: of the tags, or "auto".
        layout: "auto" finds from the photos where the tags lie; otherwise a YAML file says it (see `read_layout`).
        board: a ChArUco board instead of tags on their own.

    Raises:
        InputError: whatever is wrong with the options or photos.
    """
    if not 0 < size < 10:
        raise InputError("config", "tags.size", f"{size:g}", "the side of a tag's black square in metres, such as 0.06")
    sheets, views = find_photos(calibration, "calibration"), find_photos(photos, "photos")
    packing.check(views)
    family = guess_family(sheets) if dictionary == "auto" else dictionary
    known = None if layout == "auto" or board else read_layout(Path(layout), family, size).poses
    detector = board_detector(family, size, board) if board else tag_detector(family, size)
    log.info("%s: looking for tags of %s in %d photos", calibration, family, len(sheets))
    seen = sight(sheets, detector)
    wrong = of_one_size(calibration, {s.name: (s.width, s.height) for s in seen})
    kept = [s for s in seen if s.name not in wrong]
    log.info("%s: looking for tags in %d photos", photos, len(views))
    sightings = sight(views, detector)
    turned = of_one_size(photos, {s.name: (s.width, s.height) for s in sightings}, (kept[0].width, kept[0].height))
    usable = [s for s in sightings if s.name not in turned]
    if not any(s.marks for s in usable):
        raise InputError(
            photos,
            "",
            f"no tag of {family} in {len(usable)} photos",
            "photos with at least one whole tag in view",
            "are the folders swapped, or is tags.dictionary another one?",
        )
    lens_found = calibrate(calibration, kept, known)
    lens_found.dropped.update(wrong)
    for text in lens_found.warnings:
        log.warning("calibration: %s", text)
    for left_out, reason in lens_found.dropped.items():
        log.warning("%s left out of the calibration: %s", left_out, reason)
    lens = lens_found.lens
    log.info("focal length %.1f pixels, reprojection error %.2f pixels", lens.fx, lens_found.rms)
    solved, reasons = _place(usable, lens_found, known)
    # A wrong unit of the size, mostly.
    distance = float(np.median([np.linalg.norm(inverse(w2c)[:3, 3]) for w2c in solved.w2c.values()]))
    if not NEAREST < distance < FARTHEST:
        raise InputError(
            "config",
            "tags.size",
            f"{size:g}, which puts the cameras of {photos} {distance:.3g} m away from the tags",
            f"{NEAREST} to {FARTHEST:g} m",
            "give the side of the black square in metres: 6 cm are 0.06",
        )
    errors = {usable[i].name: float(rms) for i, rms in zip(solved.placed, solved.refined.rms, strict=True)}
    w2c = {usable[i].name: pose for i, pose in solved.w2c.items()}
    placed = {name: Placed(name, "", inverse(pose), errors[name]) for name, pose in w2c.items()}
    untagged = [s.name for s in usable if not s.marks]
    if untagged and importlib.util.find_spec("pycolmap") is None:
        reasons |= {name: reasons[name] + HINT for name in untagged}
    elif untagged:
        found, more = place_by_texture([s.path for s in usable], lens, w2c, untagged)
        reasons |= more
        placed |= {name: Placed(name, "", inverse(f.w2c), f.reprojection_px, "texture") for name, f in found.items()}
    reasons |= turned
    results = [placed[s.name] if s.name in placed else Placed(s.name, reasons[s.name]) for s in sightings]
    details = {
        "standard_deviations": lens_found.deviations,
        "reprojection_px": lens_found.rms,
        "photos_used": [s.name for s in lens_found.used],
        "photos_left_out": lens_found.dropped,
        "coverage": lens_found.coverage,
        "largest_tilt_degrees": float(np.degrees(lens_found.tilt)),
        "warnings": lens_found.warnings,
        "tags": {
            "dictionary": family,
            "size": size,
            "to_world": {tag: pose.tolist() for tag, pose in solved.tags.items()},
        },
    }
    scene = write_scene(photos, results, lens, packing, details)
    return Capture(lens_found, usable, solved, results, scene)


def _place(
    usable: Sequence[Sighting], found: Calibration, known: dict[int, np.ndarray] | None
) -> tuple[Solved, dict[str, str]]:
    """Places photos without the tags and photos that contradict the others; returns the reasons for those left out too."""
    reasons = {s.name: "no tag found" for s in usable if not s.marks}
    left = list(usable)
    while True:
        solved = solve(found.lens, [{} if s.name in reasons else s.marks for s in left], known)
        if solved is None:
            raise InputError(
                usable[0].path.parent, "", "tags that fit no camera", "photos of flat tags, of the size given"
            )
        off = misfits(solved)
        lost = {
            s.name: "its tags are not linked to those of the other photos"
            for i, s in enumerate(usable)
            if i not in solved.w2c and s.name not in reasons
        }
        if not off.photos and not off.marks:
            return solved, reasons | lost
        reasons |= {usable[i].name: off_by(error, off.usual) for i, error in off.photos.items()}
        left = [without(s, off.marks.get(i)) for i, s in enumerate(left)]
