"""The capture pipeline: two folders of photos -> scene file, cameras.json and calibration.yaml."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nerf_lightning.capture.poses.calibrate import Calibration, calibrate
from nerf_lightning.capture.poses.pose_solver import PoseSolution, RegisteredPhoto
from nerf_lightning.capture.registration import register_photos
from nerf_lightning.capture.scene_builder import build_scene
from nerf_lightning.capture.tags.board import Board, make_board_detector
from nerf_lightning.capture.tags.detect import detect_tags, guess_dictionary, make_tag_detector
from nerf_lightning.capture.tags.tag_layout import read_layout
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.sfm.photo_folder import find_photos
from nerf_lightning.utils.files import atomic_write, write_json

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Capture:
    """All results of a capture, for the report."""

    calibration: Calibration
    solution: PoseSolution
    photos: list[RegisteredPhoto]
    """Photos of the subject, in the order taken."""
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
    max_side: int | None = 300,
    holdout: int = 10,
) -> Capture:
    """Calibrates, solves the poses, and writes the scene, `cameras.json` and `calibration.yaml`; see `command.capture`.

    Args:
        calibration, photos, tag_size, output, dictionary, layout, holdout: see there.
        board: a ChArUco board instead of single tags.
        max_side: side of the scene's photos in pixels; None keeps their size.

    Raises:
        InputError: invalid options or unusable photos.
    """
    sheet_paths, paths = find_photos(calibration, "calibration"), find_photos(photos, "photos")
    dictionary = guess_dictionary(sheet_paths) if dictionary == "auto" else dictionary
    known = None if layout is None or board else read_layout(layout, dictionary, tag_size).poses
    detector = make_board_detector(dictionary, tag_size, board) if board else make_tag_detector(dictionary, tag_size)
    log.info("detecting tags of %s in %s and %s", dictionary, calibration, photos)
    sheet, observations = detect_tags(sheet_paths, detector), detect_tags(paths, detector)

    lens_calibration = calibrate(calibration, sheet, known)
    for text in lens_calibration.warnings:
        log.warning("calibration: %s", text)
    for name, reason in lens_calibration.excluded.items():
        log.warning("%s excluded from the calibration: %s", name, reason)
    log.info("focal length %.1f pixels, reprojection error %.2f pixels", lens_calibration.lens.fx, lens_calibration.rms)

    solution, registered = register_photos(photos, observations, lens_calibration.lens, known)
    for photo in registered:
        if photo.c2w is None:
            log.warning("%s excluded: %s", photo.name, photo.reason)
    c2w = {photos / photo.name: photo.c2w for photo in registered if photo.c2w is not None}
    poses = np.stack(list(c2w.values()))
    scene = build_scene(list(c2w), poses, lens_calibration.lens, output.stem, str(photos), max_side, holdout)

    save_npz(scene, output)
    _write_cameras(output.with_name("cameras.json"), registered, scene)
    to_world = {tag: pose.tolist() for tag, pose in solution.tags.items()}
    tags = {"dictionary": dictionary, "size": tag_size, "to_world": to_world}
    _write_calibration(output.with_name("calibration.yaml"), lens_calibration, tags)
    return Capture(lens_calibration, solution, registered, scene)


def _write_cameras(file: Path, photos: Sequence[RegisteredPhoto], scene: Scene) -> None:
    K = scene.train.cameras.K[0].tolist()  # of the undistorted, resized photos
    entries = [
        {
            "name": photo.name,
            "status": "left out" if photo.c2w is None else "placed",
            "reason": photo.reason,
            "K": None if photo.c2w is None else K,
            "c2w": None if photo.c2w is None else photo.c2w.tolist(),
            "reprojection_px": photo.reprojection_px,
            **({"by": photo.method} if photo.method else {}),
        }
        for photo in photos
    ]
    write_json(file, {"photos": entries})


def _write_calibration(file: Path, lens_calibration: Calibration, tags: dict[str, Any]) -> None:
    lens = lens_calibration.lens
    content = {
        "width": lens.width,
        "height": lens.height,
        **{key: float(getattr(lens, key)) for key in ("fx", "fy", "cx", "cy")},
        "distortion": dict(zip(("k1", "k2", "p1", "p2", "k3"), map(float, lens.opencv_distortion), strict=True)),
        "standard_deviations": lens_calibration.deviations,
        "reprojection_px": lens_calibration.rms,
        "photos_used": [s.name for s in lens_calibration.used_photos],
        "photos_left_out": lens_calibration.excluded,
        "coverage": lens_calibration.coverage,
        "largest_tilt_degrees": float(np.degrees(lens_calibration.tilt)),
        "warnings": lens_calibration.warnings,
        "tags": tags,
    }
    with atomic_write(file) as temporary:
        temporary.write_text(yaml.safe_dump(content, sort_keys=False, default_flow_style=None), encoding="utf-8")
