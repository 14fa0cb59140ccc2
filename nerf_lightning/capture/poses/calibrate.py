"""The lens of a camera from photos of tags: focal length, principal point, distortion, and their standard deviations."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from nerf_lightning.capture.poses.bundle import LENS_PARAMETERS
from nerf_lightning.capture.poses.solve import Pose, Solved, misfits, packed, select_model, solve
from nerf_lightning.capture.tags.detect import Mark, Sighting
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

MIN_PHOTOS = 3
MODELS: tuple[tuple[int, tuple[str, ...]], ...] = (
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
ROUNDS = 3
"""Times that the poses are solved before the lens model is chosen."""
FIRST_FOCAL = (0.7, 1.0, 1.5, 2.2)
"""First guesses of the focal length, in longest sides of the photo."""
UNSURE, MAX_UNCERTAINTY = 0.01, 0.05
"""Relative standard deviations of the focal length above which there is a warning, and an error."""
MIN_FOCAL, MAX_FOCAL = 0.35, 12.0
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
    solved: Solved
    used: list[Sighting]
    """In the order of `solved.placed`."""
    dropped: dict[str, str]
    """Photos left out, and why."""
    coverage: float
    """Share of the picture within the hull of all corners."""
    tilt: float
    """Largest angle from the frontal view of a tag, radians."""
    warnings: list[str]


def first_lens(sightings: Sequence[Sighting]) -> Intrinsics:
    """A lens to start from: only the focal length is fitted, with each mark as a target of its own (Zhang 2000, by OpenCV)."""
    width, height = sightings[0].width, sightings[0].height
    marks = [mark for sighting in sightings for mark in sighting.marks.values()]
    points = [mark.points.astype(np.float32) for mark in marks]
    pixels = [mark.pixels.astype(np.float32)[:, None] for mark in marks]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
    flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
    found: list[tuple[float, float]] = []
    for guess in FIRST_FOCAL:
        focal = guess * max(width, height)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        try:
            error, K, *_ = cv2.calibrateCamera(points, pixels, (width, height), K, np.zeros(5), flags=flags)
        except cv2.error as problem:
            log.debug("no start from a focal length of %g: %s", focal, problem)
            continue
        if np.isfinite(K).all() and 0.2 < K[0, 0] / max(width, height) < 20:
            found.append((error, float(K[0, 0])))
    focal = min(found)[1] if found else 1.2 * max(width, height)
    return Intrinsics(width, height, focal, focal, width / 2, height / 2)


def calibrate(folder: Path, sightings: Sequence[Sighting], layout: dict[int, Pose] | None) -> Calibration:
    """Fits the lens. Photos without tags, and photos that contradict the others, are dropped by name.

    Args:
        folder: where the photos are, for messages.
        sightings: all photos of one size.
        layout: tag to world; None solves it from these photos.

    Raises:
        InputError: too few photos with tags, or photos that do not determine the focal length.
    """
    used = [s for s in sightings if s.marks]
    if len(used) < MIN_PHOTOS:
        found = f"{len(used)} photos with tags of {len(sightings)}"
        advice = "take more photos of the tags, sharp, from different angles; check the dictionary"
        raise InputError(folder, "", found, f"at least {MIN_PHOTOS}", advice)
    tilt = _max_tilt(used)
    if tilt < MIN_TILT_RAD:
        found = f"photos that all look straight at the tags (tilted by {np.degrees(tilt):.0f} degrees at most)"
        raise InputError(folder, "", found, "tags seen from different angles", TILT_ADVICE)
    solved, used, dropped = _fit_consistent(folder, used, layout)
    dropped |= {s.name: "no tag found" for s in sightings if not s.marks}
    lens, refined = solved.lens, solved.refined
    corners = np.concatenate([mark.pixels for s in used for mark in s.marks.values()]).astype(np.float32)
    coverage = float(cv2.contourArea(cv2.convexHull(corners))) / (lens.width * lens.height)
    uncertainty = refined.deviations.get("focal", 0.0) / lens.fx
    longest_sides = lens.fx / max(lens.width, lens.height)
    if not uncertainty < MAX_UNCERTAINTY or not MIN_FOCAL < longest_sides < MAX_FOCAL:
        found = f"focal length {lens.fx:.0f} pixels, uncertain by {100 * uncertainty:.0f} %"
        raise InputError(folder, "", found, "tags seen from different angles", TILT_ADVICE)
    warnings = _warnings(uncertainty, tilt, coverage)
    return Calibration(lens, refined.deviations, refined.total_rms, solved, used, dropped, coverage, tilt, warnings)


def _fit_consistent(
    folder: Path, used: list[Sighting], layout: dict[int, Pose] | None
) -> tuple[Solved, list[Sighting], dict[str, str]]:
    """Fits until no photo contradicts the others.

    Returns:
        The fit, the photos behind it, and why each of the others was dropped, by name.
    """
    dropped: dict[str, str] = {}
    lens = first_lens(used)
    while True:
        solved = _fit(folder, lens, used, layout)
        lens = solved.lens
        off = misfits(solved)
        lost = {i for i in range(len(used)) if i not in solved.w2c}
        left = [drop_tag(s, off.marks.get(i)) for i, s in enumerate(used) if i not in lost | set(off.photos)]
        if not (off.photos or off.marks or lost) or len(left) < MIN_PHOTOS:
            return solved, used, dropped
        dropped |= {used[i].name: reprojection_message(error, off.usual) for i, error in off.photos.items()}
        dropped |= {used[i].name: "its tags could not be placed" for i in lost}
        used = left


def _warnings(uncertainty: float, tilt: float, coverage: float) -> list[str]:
    warnings = []
    if uncertainty > UNSURE:
        text = f"the focal length is uncertain by {100 * uncertainty:.1f} %: take more photos from other angles"
        warnings.append(text)
    if tilt < GOOD_TILT_RAD:
        warnings.append(f"the tags are tilted by {np.degrees(tilt):.0f} degrees at most: {TILT_ADVICE}")
    if coverage < GOOD_COVERAGE:
        text = (
            f"the tags cover {100 * coverage:.0f} % of the picture: bring them near its borders in some photos, else "
        )
        warnings.append(text + "distortion there is a guess")
    return warnings


def drop_tag(sighting: Sighting, tag: int | None) -> Sighting:
    """A sighting without a tag that is half hidden, bent, or mistaken for another; the same for None."""
    if tag is None:
        return sighting
    text = "%s: tag %d is ignored: it lies elsewhere than in the other photos, or is half hidden"
    log.warning(text, sighting.name, tag)
    return replace(sighting, marks={t: mark for t, mark in sighting.marks.items() if t != tag})


def reprojection_message(error: float, usual: float) -> str:
    """The reason for leaving out a photo."""
    return f"reprojection error {error:.1f} pixels (median {usual:.2f} pixels)"


def _fit(folder: Path, lens: Intrinsics, used: list[Sighting], layout: dict[int, Pose] | None) -> Solved:
    """Poses and layout from the first guess of the lens, then the best lens model that the number of photos allows."""
    marks: list[dict[int, Mark]] = [s.marks for s in used]
    rough = MODELS[1][1] if len(used) >= MODELS[1][0] else MODELS[0][1]
    # Without distortion the flipped pose of a tag can look better: with each estimate of it, poses are chosen again.
    for _ in range(ROUNDS):
        solved = solve(lens, marks, layout, rough)
        if solved is None:
            raise InputError(folder, "", "tags that no camera could have seen so", "photos of flat, undamaged tags")
        lens = solved.lens
    assert solved is not None  # ROUNDS is at least 1
    models = [free for needed, free in MODELS if len(solved.placed) >= needed]
    refined = select_model(solved.refined.bundle, models, solved.fixed)
    return packed(refined, list(solved.tags), solved.placed, solved.fixed)


def _max_tilt(used: Sequence[Sighting]) -> float:
    """The largest angle from the frontal view, by foreshortening: a frontal square stays a square at any focal length. Each
    photo is judged by its mark nearest to the middle, where distortion is least."""
    angles = []
    for s in used:
        middle = np.array([s.width / 2, s.height / 2])
        mark = min(s.marks.values(), key=lambda m: float(np.linalg.norm(m.pixels.mean(0) - middle)))
        flat = np.c_[mark.points[:, :2], np.ones(len(mark.points))]
        affine = np.linalg.lstsq(flat, mark.pixels, rcond=None)[0][:2]
        long, short = np.linalg.svd(affine, compute_uv=False)
        angles.append(float(np.arccos(np.clip(short / long, 0, 1))))
    return max(angles)
