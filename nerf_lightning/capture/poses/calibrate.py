"""Camera calibration from photos of tags: focal length, principal point, distortion, and their standard deviations."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from nerf_lightning.capture.poses.bundle_adjustment import LENS_PARAMETERS
from nerf_lightning.capture.poses.planar_pnp import Pose
from nerf_lightning.capture.poses.pose_solver import (
    PoseSolution,
    RegisteredPhoto,
    select_lens_model,
    solve_poses,
    solve_without_outliers,
)
from nerf_lightning.capture.tags.detect import PhotoObservation, find_wrong_sizes
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError

MIN_PHOTOS = 3
LENS_MODELS: tuple[tuple[int, tuple[str, ...]], ...] = (
    (3, ("focal",)),
    (4, ("focal", "k1")),
    (6, ("focal", "k1", "k2")),
    (8, ("focal", "cx", "cy", "k1")),
    (8, ("focal", "cx", "cy", "k1", "k2")),
    (10, ("focal", "cx", "cy", "k1", "k2", "p1", "p2")),
    (15, ("focal", "cx", "cy", "k1", "k2", "p1", "p2", "k3")),
    (15, LENS_PARAMETERS),
)
"""Photos required by each lens model, and its free parameters; the BIC selects among the models allowed.

With few photos the principal point would absorb bent paper and bias the focal length: it stays in the center.
"""
NUM_POSE_ROUNDS = 3
"""Rounds of solving poses before the lens model is selected."""
INITIAL_FOCAL_FRACTIONS = (0.7, 1.0, 1.5, 2.2)
"""Initial guesses of the focal length, relative to the photo's longest side."""
MAX_UNCERTAINTY, GOOD_UNCERTAINTY = 0.05, 0.01
"""Relative standard deviations of the focal length that raise an error, and a warning."""
MIN_FOCAL_FRACTION, MAX_FOCAL_FRACTION = 0.35, 12.0
"""Focal lengths relative to the photo's longest side: from a very wide angle to a long telephoto lens."""
GOOD_COVERAGE = 0.4
"""Fraction of the photo that corners should cover."""
MIN_TILT_RAD, GOOD_TILT_RAD = np.radians(8.0), np.radians(20.0)
"""Tilt that tags must, and should, have in at least one photo."""
TILT_ADVICE = "tilt the camera by 20 to 45 degrees in several photos, in different directions"


@dataclass(frozen=True)
class Calibration:
    """A calibrated lens, with its uncertainty and photos."""

    lens: Intrinsics
    deviations: dict[str, float]
    """Standard deviations of the free parameters."""
    rms: float
    """RMS reprojection error, pixels."""
    solution: PoseSolution
    photos: list[RegisteredPhoto]
    coverage: float
    """Fraction of the photo within the hull of all corners."""
    tilt: float
    """Largest angle between a tag's normal and the line of sight, radians."""
    warnings: list[str]

    @property
    def used_photos(self) -> list[PhotoObservation]:
        """Observations of the used photos, in the order of `solution.photos`."""
        return [photo.observation for photo in self.photos if not photo.reason]

    @property
    def excluded(self) -> dict[str, str]:
        """Reasons by name of the excluded photos."""
        return {photo.name: photo.reason for photo in self.photos if photo.reason}


def calibrate(folder: Path, observations: Sequence[PhotoObservation], layout: dict[int, Pose] | None) -> Calibration:
    """Calibrates the lens; excludes photos without tags, of another size than most, and outliers.

    Args:
        folder: of the photos, for messages.
        observations: all photos.
        layout: tag to world; None solves it from these photos.

    Raises:
        InputError: too few photos with tags, or photos that do not determine the focal length.
    """
    exclusions = find_wrong_sizes(folder, observations)
    used = [s for s in observations if s.detections and s.name not in exclusions]
    if len(used) < MIN_PHOTOS:
        problem = f"{len(used)} photos with tags of {len(observations)}"
        advice = "take more photos of the tags, sharp, from different angles; check the dictionary"
        raise InputError(folder, "", problem, f"at least {MIN_PHOTOS}", advice)
    tilt = max(_measure_tilt(s) for s in used)
    if tilt < MIN_TILT_RAD:
        problem = f"all photos look straight at the tags (tilted by {np.degrees(tilt):.0f} degrees at most)"
        raise InputError(folder, "", problem, hint=TILT_ADVICE)
    initial_lens = estimate_initial_lens(used)
    solution, photos = solve_without_outliers(
        observations, exclusions, lambda left: _fit_lens_model(initial_lens, left, layout), MIN_PHOTOS
    )
    lens, refined = solution.lens, solution.refined
    corners = [tag.pixels for photo in photos if not photo.reason for tag in photo.observation.detections.values()]
    hull = cv2.convexHull(np.concatenate(corners).astype(np.float32))
    coverage = float(cv2.contourArea(hull)) / (lens.width * lens.height)
    uncertainty = refined.deviations.get("focal", 0.0) / lens.fx
    focal_fraction = lens.fx / max(lens.width, lens.height)
    if not uncertainty < MAX_UNCERTAINTY or not MIN_FOCAL_FRACTION < focal_fraction < MAX_FOCAL_FRACTION:
        problem = f"focal length {lens.fx:.0f} pixels, uncertain by {100 * uncertainty:.0f} %"
        raise InputError(folder, "", problem, hint=TILT_ADVICE)
    warnings = {
        f"the focal length is uncertain by {100 * uncertainty:.1f} %: take more photos from other angles": (
            uncertainty > GOOD_UNCERTAINTY
        ),
        f"the tags are tilted by {np.degrees(tilt):.0f} degrees at most: {TILT_ADVICE}": tilt < GOOD_TILT_RAD,
        f"the tags cover {100 * coverage:.0f} % of the photo: bring them near its borders in some photos, else"
        " distortion there is extrapolated": coverage < GOOD_COVERAGE,
    }
    issued = [text for text, applies in warnings.items() if applies]
    return Calibration(lens, refined.deviations, refined.total_rms, solution, photos, coverage, tilt, issued)


def estimate_initial_lens(observations: Sequence[PhotoObservation]) -> Intrinsics:
    """Initial lens: fits only the focal length, with each tag as a separate target (Zhang 2000, by OpenCV)."""
    width, height = observations[0].width, observations[0].height
    detections = [detection for observation in observations for detection in observation.detections.values()]
    points = [detection.points.astype(np.float32) for detection in detections]
    pixels = [detection.pixels.astype(np.float32)[:, None] for detection in detections]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    candidates: list[tuple[float, float]] = []
    for fraction in INITIAL_FOCAL_FRACTIONS:
        focal = fraction * max(width, height)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        with suppress(cv2.error):  # no convergence from this guess
            error, K, *_ = cv2.calibrateCamera(points, pixels, (width, height), K, np.zeros(5), flags=flags)
            if 0.2 < K[0, 0] / max(width, height) < 20:
                candidates.append((error, float(K[0, 0])))
    focal = min(candidates)[1] if candidates else 1.2 * max(width, height)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def _fit_lens_model(lens: Intrinsics, used: Sequence[PhotoObservation], layout: dict[int, Pose] | None) -> PoseSolution:
    """Fits poses and layout with the initial lens, then selects the lens model."""
    rough = LENS_MODELS[1][1] if len(used) >= LENS_MODELS[1][0] else LENS_MODELS[0][1]
    solution = solve_poses(lens, used, layout, rough)
    # Without distortion a tag's flipped pose can fit better: poses are chosen again with each estimate of it.
    for _ in range(NUM_POSE_ROUNDS - 1):
        solution = solve_poses(solution.lens, used, layout, rough)
    models = [free for needed, free in LENS_MODELS if len(solution.photos) >= needed]
    return replace(solution, refined=select_lens_model(solution.refined.bundle, models, solution.fixed))


def _measure_tilt(observation: PhotoObservation) -> float:
    """Tilt of the tag nearest to the image center by its foreshortening, radians, which needs no focal length."""
    middle = np.array([observation.width / 2, observation.height / 2])
    detection = min(observation.detections.values(), key=lambda m: float(np.linalg.norm(m.pixels.mean(0) - middle)))
    flat = np.c_[detection.points[:, :2], np.ones(len(detection.points))]
    affine = np.linalg.lstsq(flat, detection.pixels, rcond=None)[0][:2]
    long, short = np.linalg.svd(affine, compute_uv=False)
    return float(np.arccos(np.clip(short / long, 0, 1)))
