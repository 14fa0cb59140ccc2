"""From two folders of photos to a scene file and the files beside it."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nerf_lightning.capture.pack import pack
from nerf_lightning.capture.place import place_photos
from nerf_lightning.capture.poses.calibrate import Calibration, calibrate
from nerf_lightning.capture.poses.solve import PlacedPhoto, Solved
from nerf_lightning.capture.tags.board import Board, board_detector
from nerf_lightning.capture.tags.detect import detect_in_photos, guess_family, tag_detector
from nerf_lightning.capture.tags.layout import read_layout
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.sfm.photos import find_photos
from nerf_lightning.utils.files import atomic, write_json

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Capture:
    """All results, for the report."""

    calibration: Calibration
    solved: Solved
    photos: list[PlacedPhoto]
    """Of the subject, in the order taken."""
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
    sheet_paths, paths = find_photos(calibration, "calibration"), find_photos(photos, "photos")
    family = guess_family(sheet_paths) if dictionary == "auto" else dictionary
    known = None if layout is None or board else read_layout(layout, family, tag_size).poses
    detector = board_detector(family, tag_size, board) if board else tag_detector(family, tag_size)
    log.info("looking for tags of %s in %s and %s", family, calibration, photos)
    sheet, sightings = detect_in_photos(sheet_paths, detector), detect_in_photos(paths, detector)

    found = calibrate(calibration, sheet, known)
    for text in found.warnings:
        log.warning("calibration: %s", text)
    for name, reason in found.dropped.items():
        log.warning("%s left out of the calibration: %s", name, reason)
    log.info("focal length %.1f pixels, reprojection error %.2f pixels", found.lens.fx, found.rms)

    solved, placed = place_photos(photos, sightings, found.lens, known)
    for photo in placed:
        if photo.c2w is None:
            log.warning("%s left out: %s", photo.name, photo.reason)
    c2w = {photos / photo.name: photo.c2w for photo in placed if photo.c2w is not None}
    scene = pack(list(c2w), np.stack(list(c2w.values())), found.lens, output.stem, str(photos), longest, holdout)

    save_npz(scene, output)
    _write_cameras(output.with_name("cameras.json"), placed, scene)
    tags = {"dictionary": family, "size": tag_size, "to_world": {tag: p.tolist() for tag, p in solved.tags.items()}}
    _write_calibration(output.with_name("calibration.yaml"), found, tags)
    return Capture(found, solved, placed, scene)


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
        "width": lens.width,
        "height": lens.height,
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
