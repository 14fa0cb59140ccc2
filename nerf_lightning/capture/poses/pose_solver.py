"""Solves tag and camera poses from the photos alone."""

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.bundle_adjustment import (
    Bundle,
    RefinedBundle,
    adjust_bundle,
    rms_length,
    simplify_lens,
)
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import invert_pose
from nerf_lightning.capture.poses.planar_pnp import (
    Hypothesis,
    Pose,
    collect_correspondences,
    estimate_camera_poses,
    estimate_tag_poses,
)
from nerf_lightning.capture.tags.detect import PhotoObservation
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

MAX_DISAGREEMENT_RAD, MAX_DISAGREEMENT_FRACTION = np.radians(10.0), 0.25
"""Two photos agree on the relative pose of two tags within this rotation, and this fraction of the tags' distance."""
OUTLIER_RATIO, MIN_OUTLIER_PX = 4.0, 1.0
"""Outliers have errors above this multiple of the median, and above this many pixels at 1000 px along the longest side."""


@dataclass(frozen=True)
class PoseSolution:
    """Camera and tag poses in one world frame."""

    refined: RefinedBundle
    photos: tuple[str, ...]
    """Names of the registered photos, in the order of `refined`."""
    ids: tuple[int, ...]
    """Tag ids, in the order of `refined`."""
    fixed: frozenset[int]
    """Indices in `ids` of the tags that fix the world frame."""

    @property
    def lens(self) -> Intrinsics:
        return self.refined.bundle.lens

    @property
    def tags(self) -> dict[int, Pose]:
        """Tag to world, by id."""
        return dict(zip(self.ids, self.refined.bundle.tags, strict=True))

    @property
    def w2c(self) -> dict[str, Pose]:
        """World to camera, by photo name."""
        return dict(zip(self.photos, self.refined.bundle.w2c, strict=True))

    def residuals_by_tag(self, photo: str) -> dict[int, Float[np.ndarray, "_ 2"]]:
        """Residuals (projected - detected), pixels, by tag id."""
        number = self.photos.index(photo)
        detections = self.refined.bundle.detections[number]
        ends = np.cumsum([len(detection.pixels) for detection in detections.values()])[:-1]
        split = np.split(self.refined.residuals[number], ends)
        return {self.ids[row]: residuals for row, residuals in zip(detections, split, strict=True)}


@dataclass(frozen=True)
class RegisteredPhoto:
    """A photo with its pose, or the reason why it has none."""

    observation: PhotoObservation
    reason: str = ""
    """Why it was excluded; "" if it was registered."""
    c2w: Pose | None = None
    """OpenCV frame, meters."""
    reprojection_px: float | None = None
    """RMS reprojection error."""
    residuals: dict[int, Float[np.ndarray, "_ 2"]] = field(default_factory=dict)
    """Residuals (projected - detected), pixels, by tag id."""
    method: str = ""
    """"texture" if it shows no tag and was registered against the photos that do; else ""."""

    @property
    def name(self) -> str:
        return self.observation.name


def estimate_relative_poses(
    observations: Sequence[Mapping[int, list[Hypothesis]]],
) -> dict[tuple[int, int], tuple[Pose, int]]:
    """Relative pose of each pair of tags that most photos agree on, and their number.

    Each photo contributes all combinations of its tags' solutions; correct ones agree between photos, flipped ones do not.
    """
    candidates: dict[tuple[int, int], list[list[Pose]]] = defaultdict(list)
    for poses in observations:
        tags = sorted(tag for tag, solutions in poses.items() if solutions)
        for i, a in enumerate(tags):
            for b in tags[i + 1 :]:
                candidates[a, b].append([invert_pose(x.pose) @ y.pose for x in poses[a] for y in poses[b]])
    return {pair: _find_consensus(photos) for pair, photos in candidates.items()}


def _find_consensus(photos: list[list[Pose]]) -> tuple[Pose, int]:
    """Selects the relative pose that most photos agree with; ties go to the smallest misfit."""
    poses = np.stack([pose for candidates in photos for pose in candidates])
    turns, shifts = poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]
    # |A - B|^2 = 8 sin^2(angle / 2) = 6 - 2 <A, B> for rotations A and B.
    chord = np.sqrt(np.clip(6 - 2 * turns @ turns.T, 0, 8) / 8)
    distance = np.linalg.norm(shifts[:, None] - shifts, axis=2)
    tolerance = MAX_DISAGREEMENT_FRACTION * np.maximum(np.linalg.norm(shifts, axis=1), 1e-9)
    deviation = np.stack([2 * np.arcsin(chord) / MAX_DISAGREEMENT_RAD, distance / tolerance[:, None]])
    misfit = np.where((deviation < 1).all(0), deviation.sum(0), 2.0)
    starts = np.cumsum([0, *(len(candidates) for candidates in photos)])[:-1]
    nearest = np.minimum.reduceat(misfit, starts, axis=1)
    count = (nearest < 2).sum(1)
    best = np.lexsort((nearest.sum(1), -count))[0]
    return poses[best], int(count[best])


def chain_tag_poses(pairs: Mapping[tuple[int, int], tuple[Pose, int]], reference: int) -> dict[int, Pose]:
    """Chains relative poses from the reference tag, greedily by the number of agreeing photos.

    Returns:
        Poses of all linked tags in the reference tag's frame.
    """
    poses = {reference: np.eye(4)}
    while True:
        links = [(count, a, b, pose) for (a, b), (pose, count) in pairs.items() if (a in poses) != (b in poses)]
        if not links:
            return poses
        _, a, b, pose = max(links, key=lambda link: (link[0], -link[1], -link[2]))
        if a in poses:
            poses[b] = poses[a] @ pose
        else:
            poses[a] = poses[b] @ invert_pose(pose)


def solve_poses(
    lens: Intrinsics,
    observations: Sequence[PhotoObservation],
    layout: Mapping[int, Pose] | None,
    free_lens: tuple[str, ...] = (),
) -> PoseSolution:
    """Solves the poses of photos and tags, and refines them by bundle adjustment.

    Args:
        lens: an initial guess, or the calibrated lens.
        observations: photos in the order taken; those without a tag linked to the others are ignored.
        layout: tag to world; None solves it from the photos, in the frame of the most detected tag.
        free_lens: free lens parameters; see `adjust_bundle`.

    Raises:
        InputError: no photo can be registered.
    """
    options = [{tag: estimate_tag_poses(lens, corners) for tag, corners in s.detections.items()} for s in observations]
    counts = Counter(tag for by_tag in options for tag, poses in by_tag.items() if poses)
    # Ties go to the smallest id, so that the frame does not depend on the order of photos.
    reference = max(sorted(counts), key=counts.__getitem__, default=-1)
    tags = layout if layout is not None else chain_tag_poses(estimate_relative_poses(options), reference)
    registered = [(s, poses) for s in observations if (poses := estimate_camera_poses(lens, s.detections, tags))]
    if not registered:
        folder = observations[0].path.parent
        raise InputError(folder, "", "the tags fit no camera", hint="keep them flat and give their true size")
    points = [collect_correspondences(s.detections, tags)[0] for s, _ in registered]
    chosen = resolve_flips([poses for _, poses in registered], points)
    ids = tuple(sorted({tag for s, _ in registered for tag in s.detections if tag in tags}))
    row = {tag: n for n, tag in enumerate(ids)}
    bundle = Bundle(
        lens,
        np.stack([poses[c].pose for (_, poses), c in zip(registered, chosen, strict=True)]),
        np.stack([tags[tag] for tag in ids]),
        [{row[tag]: detection for tag, detection in s.detections.items() if tag in row} for s, _ in registered],
        np.zeros(len(ids)),
    )
    fixed = frozenset(row.values()) if layout is not None else frozenset({row[reference]})
    return PoseSolution(select_lens_model(bundle, [free_lens], fixed), tuple(s.name for s, _ in registered), ids, fixed)


def select_lens_model(bundle: Bundle, models: Sequence[tuple[str, ...]], fixed: frozenset[int]) -> RefinedBundle:
    """Adjusts the bundle with each lens model and selects the invertible one of lowest BIC; then tries twisted tags.

    Parameters that are not free take their defaults; a model without free parameters keeps the lens.
    """
    fits: list[RefinedBundle] = []
    for free in models:
        start = fits[-1].bundle if fits else bundle  # models are nested: each starts from the previous one
        fits.append(adjust_bundle(replace(start, lens=simplify_lens(start.lens, free)), free, fixed))
    # A polynomial fitted only to the image center may fold back; the simplest model is the fallback.
    invertible = [fit for fit in fits if fit.bundle.lens.is_invertible()] or fits[:1]
    best = min(invertible, key=lambda fit: fit.bic)
    twisted = adjust_bundle(best.bundle, models[fits.index(best)], fixed, free_twists=True)
    return min(best, twisted, key=lambda fit: fit.bic)


def solve_without_outliers(
    observations: Sequence[PhotoObservation],
    exclusions: Mapping[str, str],
    fit: Callable[[Sequence[PhotoObservation]], PoseSolution],
    min_photos: int = 1,
) -> tuple[PoseSolution, list[RegisteredPhoto]]:
    """Solves repeatedly, dropping outlier photos and tags, until there are none or too few photos remain.

    Args:
        observations: in the order taken.
        exclusions: reasons by name of the photos excluded from the start.
        fit: solves for a subset of the photos.
        min_photos: fewest photos to continue with.

    Returns:
        The solution, and all photos.
    """
    reasons = {s.name: "no tag found" for s in observations if not s.detections} | dict(exclusions)
    kept = [s for s in observations if s.name not in reasons]
    while True:
        solution = fit(kept)
        remaining, outliers = drop_outliers(solution, kept)
        if len(remaining) < min_photos or (not outliers and all(a is b for a, b in zip(remaining, kept, strict=True))):
            break
        kept, reasons = remaining, reasons | outliers
    used, w2c = {s.name: s for s in kept}, solution.w2c
    photos = []
    for observation in observations:
        name = observation.name
        if name in w2c:
            residuals = solution.residuals_by_tag(name)
            error = rms_length(np.concatenate(list(residuals.values())))
            photos.append(RegisteredPhoto(used[name], "", invert_pose(w2c[name]), error, residuals))
        else:
            unlinked = "its tags are not linked to those of the other photos"
            photos.append(RegisteredPhoto(observation, reasons.get(name, unlinked)))
    return solution, photos


def drop_outliers(
    solution: PoseSolution, observations: Sequence[PhotoObservation]
) -> tuple[list[PhotoObservation], dict[str, str]]:
    """Drops outlier tags (half hidden, bent, or misidentified), and photos more than half of whose tags are outliers.

    Returns:
        The remaining observations, and why each photo was excluded, by name.
    """
    errors = solution.refined.rms
    median, side = float(np.median(errors)), max(solution.lens.width, solution.lens.height)
    limit = max(OUTLIER_RATIO * median, MIN_OUTLIER_PX * side / 1000)
    reasons, hidden = {}, {}
    for i in np.flatnonzero(errors > limit).tolist():
        name = solution.photos[i]
        by_tag = {tag: rms_length(residuals) for tag, residuals in solution.residuals_by_tag(name).items()}
        if 2 * sum(error > limit for error in by_tag.values()) > len(by_tag):
            reasons[name] = f"reprojection error {errors[i]:.1f} pixels (median {median:.2f} pixels)"
        else:
            hidden[name] = max(by_tag, key=by_tag.__getitem__)
            text = "%s: tag %d is ignored: its position contradicts the other photos, or it is half hidden"
            log.warning(text, name, hidden[name])
    remaining = [s for s in observations if s.name not in reasons]
    for i, s in enumerate(remaining):
        if s.name in hidden:
            visible = {tag: corners for tag, corners in s.detections.items() if tag != hidden[s.name]}
            remaining[i] = replace(s, detections=visible)
    return remaining, reasons
