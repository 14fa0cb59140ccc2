"""The lens of a camera from photos of tags: focal length, principal point, distortion, and their standard deviations."""

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
"""Photos needed, and the lens parameters that these may free; the BIC decides among the models allowed.

With few photos the principal point would absorb the effect of bent paper, and spoil the focal length: it stays in the middle.
"""
NUM_POSE_ROUNDS = 3
"""Times that the poses are solved before the lens model is chosen."""
INITIAL_FOCAL_FRACTIONS = (0.7, 1.0, 1.5, 2.2)
"""First guesses of the focal length, in longest sides of the photo."""
MAX_UNCERTAINTY, GOOD_UNCERTAINTY = 0.05, 0.01
"""Relative standard deviations of the focal length above which there is an error, and a warning."""
MIN_FOCAL_FRACTION, MAX_FOCAL_FRACTION = 0.35, 12.0
"""Focal lengths in longest sides of the photo: from a very wide angle to a long telephoto lens."""
GOOD_COVERAGE = 0.4
"""Share of the picture that corners should span."""
MIN_TILT_RAD, GOOD_TILT_RAD = np.radians(8.0), np.radians(20.0)
"""How far tags must, and should, be tilted in at least one photo."""
TILT_ADVICE = "tilt the camera by 20 to 45 degrees in several photos, in different directions"


@dataclass(frozen=True)
class Calibration:
    """A calibrated lens, and the photos and figures behind it."""

    lens: Intrinsics
    deviations: dict[str, float]
    """Standard deviations of the free parameters; the others kept their plain values."""
    rms: float
    """Root mean square reprojection error, pixels."""
    solution: PoseSolution
    photos: list[RegisteredPhoto]
    """All that were given."""
    coverage: float
    """Share of the picture within the hull of all corners."""
    tilt: float
    """Largest angle from the frontal view of a tag, radians."""
    warnings: list[str]

    @property
    def used_photos(self) -> list[PhotoObservation]:
        """What the photos behind it show, in the order of `solution.photos`."""
        return [photo.observation for photo in self.photos if not photo.reason]

    @property
    def excluded(self) -> dict[str, str]:
        """Photos left out, and why."""
        return {photo.name: photo.reason for photo in self.photos if photo.reason}


def calibrate(folder: Path, observations: Sequence[PhotoObservation], layout: dict[int, Pose] | None) -> Calibration:
    """Fits the lens. Photos without tags, of another size than most, and those that contradict the others, are left out.

    Args:
        folder: where the photos are, for messages.
        observations: all photos.
        layout: tag to world; None solves it from these photos.

    Raises:
        InputError: too few photos with tags, or photos that do not determine the focal length.
    """
    exclusions = find_wrong_sizes(folder, observations)
    used = [s for s in observations if s.detections and s.name not in exclusions]
    if len(used) < MIN_PHOTOS:
        found = f"{len(used)} photos with tags of {len(observations)}"
        advice = "take more photos of the tags, sharp, from different angles; check the dictionary"
        raise InputError(folder, "", found, f"at least {MIN_PHOTOS}", advice)
    tilt = max(_measure_tilt(s) for s in used)
    if tilt < MIN_TILT_RAD:
        found = f"all photos look straight at the tags (tilted by {np.degrees(tilt):.0f} degrees at most)"
        raise InputError(folder, "", found, hint=TILT_ADVICE)
    first = estimate_initial_lens(used)
    solution, photos = solve_without_outliers(
        observations, exclusions, lambda left: _fit_lens_model(first, left, layout), MIN_PHOTOS
    )
    lens, refined = solution.lens, solution.refined
    corners = [
        detection.pixels for photo in photos if not photo.reason for detection in photo.observation.detections.values()
    ]
    hull = cv2.convexHull(np.concatenate(corners).astype(np.float32))
    coverage = float(cv2.contourArea(hull)) / (lens.width * lens.height)
    uncertainty = refined.deviations.get("focal", 0.0) / lens.fx
    focal_fraction = lens.fx / max(lens.width, lens.height)
    if not uncertainty < MAX_UNCERTAINTY or not MIN_FOCAL_FRACTION < focal_fraction < MAX_FOCAL_FRACTION:
        found = f"focal length {lens.fx:.0f} pixels, uncertain by {100 * uncertainty:.0f} %"
        raise InputError(folder, "", found, hint=TILT_ADVICE)
    warnings = {
        f"the focal length is uncertain by {100 * uncertainty:.1f} %: take more photos from other angles": (
            uncertainty > GOOD_UNCERTAINTY
        ),
        f"the tags are tilted by {np.degrees(tilt):.0f} degrees at most: {TILT_ADVICE}": tilt < GOOD_TILT_RAD,
        f"the tags cover {100 * coverage:.0f} % of the picture: bring them near its borders in some photos, else"
        " distortion there is a guess": coverage < GOOD_COVERAGE,
    }
    applying = [text for text, applies in warnings.items() if applies]
    return Calibration(lens, refined.deviations, refined.total_rms, solution, photos, coverage, tilt, applying)


def estimate_initial_lens(observations: Sequence[PhotoObservation]) -> Intrinsics:
    """A lens to start from: only the focal length is fitted, with each mark as a target of its own (Zhang 2000, by OpenCV)."""
    width, height = observations[0].width, observations[0].height
    detections = [detection for observation in observations for detection in observation.detections.values()]
    points = [detection.points.astype(np.float32) for detection in detections]
    pixels = [detection.pixels.astype(np.float32)[:, None] for detection in detections]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    found: list[tuple[float, float]] = []
    for fraction in INITIAL_FOCAL_FRACTIONS:
        focal = fraction * max(width, height)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        with suppress(cv2.error):  # no start from there
            error, K, *_ = cv2.calibrateCamera(points, pixels, (width, height), K, np.zeros(5), flags=flags)
            if 0.2 < K[0, 0] / max(width, height) < 20:
                found.append((error, float(K[0, 0])))
    focal = min(found)[1] if found else 1.2 * max(width, height)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def _fit_lens_model(lens: Intrinsics, used: Sequence[PhotoObservation], layout: dict[int, Pose] | None) -> PoseSolution:
    """Poses and layout from the first guess of the lens, then the best lens model that the number of photos allows."""
    rough = LENS_MODELS[1][1] if len(used) >= LENS_MODELS[1][0] else LENS_MODELS[0][1]
    solution = solve_poses(lens, used, layout, rough)
    # Without distortion the flipped pose of a tag can look better: with each estimate of it, poses are chosen again.
    for _ in range(NUM_POSE_ROUNDS - 1):
        solution = solve_poses(solution.lens, used, layout, rough)
    models = [free for needed, free in LENS_MODELS if len(solution.photos) >= needed]
    return replace(solution, refined=select_lens_model(solution.refined.bundle, models, solution.fixed))


def _measure_tilt(observation: PhotoObservation) -> float:
    """The angle from the frontal view by foreshortening, radians: a frontal square stays a square at any focal length. Judged
    by the mark nearest to the middle, where distortion is least."""
    middle = np.array([observation.width / 2, observation.height / 2])
    detection = min(observation.detections.values(), key=lambda m: float(np.linalg.norm(m.pixels.mean(0) - middle)))
    flat = np.c_[detection.points[:, :2], np.ones(len(detection.points))]
    affine = np.linalg.lstsq(flat, detection.pixels, rcond=None)[0][:2]
    long, short = np.linalg.svd(affine, compute_uv=False)
    return float(np.arccos(np.clip(short / long, 0, 1)))
