"""Where the tags lie and where the cameras stood, from the photos alone."""

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

MAX_DISAGREEMENT_RAD = np.radians(10.0)
"""Two photos say the same of two tags if they differ by less than this angle, and ..."""
MAX_DISAGREEMENT_FRACTION = 0.25
"""... by less than this share of the tags' distance (or of a tag, where they touch)."""
OUTLIER_RATIO = 4.0
"""A photo is off if its error is more than this times the median, and also above ..."""
MIN_OUTLIER_PX = 1.0
"""... this at 1000 pixels along the longest side."""


@dataclass(frozen=True)
class PoseSolution:
    """Cameras and tags in one frame."""

    refined: RefinedBundle
    photos: tuple[str, ...]
    """Names of the photos that were placed, in the order of `refined`."""
    ids: tuple[int, ...]
    """Of the tags, in the order of `refined`."""
    fixed: frozenset[int]
    """Which of the tags, counted in the order of `ids`, hold the world in place."""

    @property
    def lens(self) -> Intrinsics:
        return self.refined.bundle.lens

    @property
    def tags(self) -> dict[int, Pose]:
        """Tag to world, by id."""
        return dict(zip(self.ids, self.refined.bundle.tags, strict=True))

    @property
    def w2c(self) -> dict[str, Pose]:
        """World to camera, by the photo's name."""
        return dict(zip(self.photos, self.refined.bundle.w2c, strict=True))

    def residuals_by_tag(self, photo: str) -> dict[int, Float[np.ndarray, "_ 2"]]:
        """Projected minus seen, pixels, by the tag's id."""
        number = self.photos.index(photo)
        detections = self.refined.bundle.detections[number]
        ends = np.cumsum([len(detection.pixels) for detection in detections.values()])[:-1]
        split = np.split(self.refined.residuals[number], ends)
        return {self.ids[row]: residuals for row, residuals in zip(detections, split, strict=True)}


@dataclass(frozen=True)
class RegisteredPhoto:
    """A photo with its camera, or the reason why it has none."""

    observation: PhotoObservation
    reason: str = ""
    """Why it was left out; "" if it was placed."""
    c2w: Pose | None = None
    """OpenCV frame, metres."""
    reprojection_px: float | None = None
    """Root mean square reprojection error."""
    residuals: dict[int, Float[np.ndarray, "_ 2"]] = field(default_factory=dict)
    """Projected minus seen, pixels, by the tag's id."""
    method: str = ""
    """"texture" if it shows no tag, and was placed against the photos that do; "" if as the others."""

    @property
    def name(self) -> str:
        return self.observation.name


def estimate_relative_poses(
    observations: Sequence[Mapping[int, list[Hypothesis]]],
) -> dict[tuple[int, int], tuple[Pose, int]]:
    """The motion from one tag's frame to another's that most photos agree on, and how many do.

    Each photo offers all combinations of its tags' solutions; the right ones agree between photos, the flipped do not.
    """
    offers: dict[tuple[int, int], list[list[Pose]]] = defaultdict(list)
    for poses in observations:
        tags = sorted(tag for tag, found in poses.items() if found)
        for i, a in enumerate(tags):
            for b in tags[i + 1 :]:
                offers[a, b].append([invert_pose(x.pose) @ y.pose for x in poses[a] for y in poses[b]])
    return {pair: _find_consensus(photos) for pair, photos in offers.items()}


def _find_consensus(photos: list[list[Pose]]) -> tuple[Pose, int]:
    """Of all motions the one that most photos agree with, the nearest ones where several do."""
    poses = np.stack([pose for offered in photos for pose in offered])
    turns, shifts = poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]
    # |A - B|^2 = 8 sin^2(angle / 2) = 6 - 2 <A, B> for rotations A and B.
    chord = np.sqrt(np.clip(6 - 2 * turns @ turns.T, 0, 8) / 8)
    distance = np.linalg.norm(shifts[:, None] - shifts, axis=2)
    reach = MAX_DISAGREEMENT_FRACTION * np.maximum(np.linalg.norm(shifts, axis=1), 1e-9)
    off = np.stack([2 * np.arcsin(chord) / MAX_DISAGREEMENT_RAD, distance / reach[:, None]])
    misfit = np.where((off < 1).all(0), off.sum(0), 2.0)
    starts = np.cumsum([0, *(len(offered) for offered in photos)])[:-1]
    nearest = np.minimum.reduceat(misfit, starts, axis=1)
    count = (nearest < 2).sum(1)
    best = np.lexsort((nearest.sum(1), -count))[0]
    return poses[best], int(count[best])


def chain_tag_poses(pairs: Mapping[tuple[int, int], tuple[Pose, int]], reference: int) -> dict[int, Pose]:
    """Places all tags that are linked to the reference, starting with the links that most photos agree on.

    Returns:
        Tag to the reference tag's frame.
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
    """Places photos and tags, and refines everything together.

    Args:
        lens: a first guess, or the calibrated lens.
        observations: photos in the order taken; those that show no tag linked to the others are not placed.
        layout: tag to world; None solves it from the photos, in the frame of the tag seen most.
        free_lens: parameters of the lens that may change too; see `adjust_bundle`.

    Raises:
        InputError: no photo can be placed.
    """
    alone = [
        {tag: estimate_tag_poses(lens, detection) for tag, detection in s.detections.items()} for s in observations
    ]
    counts = Counter(tag for poses in alone for tag, found in poses.items() if found)
    # The smallest id among the most seen, so that the frame does not depend on the order of photos.
    reference = max(sorted(counts), key=counts.__getitem__, default=-1)
    tags = layout if layout is not None else chain_tag_poses(estimate_relative_poses(alone), reference)
    options = [(s, found) for s in observations if (found := estimate_camera_poses(lens, s.detections, tags))]
    if not options:
        folder = observations[0].path.parent
        raise InputError(folder, "", "the tags fit no camera", hint="keep them flat and give their true size")
    chosen = resolve_flips(
        [found for _, found in options], [collect_correspondences(s.detections, tags)[0] for s, _ in options]
    )
    ids = tuple(sorted({tag for s, _ in options for tag in s.detections if tag in tags}))
    row = {tag: n for n, tag in enumerate(ids)}
    bundle = Bundle(
        lens,
        np.stack([found[c].pose for (_, found), c in zip(options, chosen, strict=True)]),
        np.stack([tags[tag] for tag in ids]),
        [{row[tag]: detection for tag, detection in s.detections.items() if tag in row} for s, _ in options],
        np.zeros(len(ids)),
    )
    fixed = frozenset(row.values()) if layout is not None else frozenset({row[reference]})
    return PoseSolution(select_lens_model(bundle, [free_lens], fixed), tuple(s.name for s, _ in options), ids, fixed)


def select_lens_model(bundle: Bundle, models: Sequence[tuple[str, ...]], fixed: frozenset[int]) -> RefinedBundle:
    """Refines with each lens model and takes the one of lowest BIC whose lens does not fold the picture; then the same with
    twisted tags.

    Parameters that a model does not free have their plain value; a model that frees none keeps the lens.
    """
    fits: list[RefinedBundle] = []
    for free in models:
        start = fits[-1].bundle if fits else bundle  # models grow: each starts where the one before ended
        fits.append(adjust_bundle(replace(start, lens=simplify_lens(start.lens, free)), free, fixed))
    # A polynomial fitted only to the middle of the picture may turn back; the plainest model is the fallback.
    sound = [fit for fit in fits if fit.bundle.lens.is_invertible()] or fits[:1]
    best = min(sound, key=lambda fit: fit.bic)
    twisted = adjust_bundle(best.bundle, models[fits.index(best)], fixed, free_twists=True)
    return min(best, twisted, key=lambda fit: fit.bic)


def solve_without_outliers(
    observations: Sequence[PhotoObservation],
    exclusions: Mapping[str, str],
    fit: Callable[[Sequence[PhotoObservation]], PoseSolution],
    min_photos: int = 1,
) -> tuple[PoseSolution, list[RegisteredPhoto]]:
    """Solves again without the photos and marks that contradict the others, until none does or too few photos are left.

    Args:
        observations: in the order taken.
        exclusions: why photos are left out from the start, by name.
        fit: solves for some of the photos.
        min_photos: that are enough to go on.

    Returns:
        The solution, and all photos.
    """
    reasons = {s.name: "no tag found" for s in observations if not s.detections} | dict(exclusions)
    left = [s for s in observations if s.name not in reasons]
    while True:
        solution = fit(left)
        remaining, off = drop_outliers(solution, left)
        if len(remaining) < min_photos or (not off and all(a is b for a, b in zip(remaining, left, strict=True))):
            break
        left, reasons = remaining, reasons | off
    used, w2c = {s.name: s for s in left}, solution.w2c
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
    """Leaves out what is off by far more than the rest: a tag that is half hidden, bent, or mistaken for another; and a photo
    more than half of whose tags are.

    Returns:
        The sightings that are left, and why each photo was left out, by name.
    """
    errors = solution.refined.rms
    median, side = float(np.median(errors)), max(solution.lens.width, solution.lens.height)
    limit = max(OUTLIER_RATIO * median, MIN_OUTLIER_PX * side / 1000)
    reasons, hidden = {}, {}
    for i in np.flatnonzero(errors > limit).tolist():
        name = solution.photos[i]
        by_mark = {tag: rms_length(rest) for tag, rest in solution.residuals_by_tag(name).items()}
        if 2 * sum(error > limit for error in by_mark.values()) > len(by_mark):
            reasons[name] = f"reprojection error {errors[i]:.1f} pixels (median {median:.2f} pixels)"
        else:
            hidden[name] = max(by_mark, key=by_mark.__getitem__)
            text = "%s: tag %d is ignored: it lies elsewhere than in the other photos, or is half hidden"
            log.warning(text, name, hidden[name])
    remaining = [s for s in observations if s.name not in reasons]
    for i, s in enumerate(remaining):
        if s.name in hidden:
            remaining[i] = replace(
                s, detections={tag: detection for tag, detection in s.detections.items() if tag != hidden[s.name]}
            )
    return remaining, reasons
