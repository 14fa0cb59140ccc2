"""Where the tags lie and where the cameras stood, from the photos alone."""

import logging
from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.bundle import Bundle, Refined, refine, rms_length, simplified
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import inverse
from nerf_lightning.capture.poses.pose import Hypothesis, Pose, mark_poses, photo_poses, points_and_pixels
from nerf_lightning.capture.tags.detect import Sighting
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

MAX_ANGLE_RAD = np.radians(10.0)
"""Two photos say the same of two tags if they differ by less than this angle, and ..."""
MAX_SHIFT_FRACTION = 0.25
"""... by less than this share of the tags' distance (or of a tag, where they touch)."""
OUTLIER_RATIO = 4.0
"""A photo is off if its error is more than this times the median, and also above ..."""
MIN_OUTLIER_PX = 1.0
"""... this at 1000 pixels along the longest side."""


@dataclass(frozen=True)
class Solved:
    """Cameras and tags in one frame."""

    refined: Refined
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

    def residuals_of(self, photo: str) -> dict[int, Float[np.ndarray, "_ 2"]]:
        """Projected minus seen, pixels, by the tag's id."""
        number = self.photos.index(photo)
        marks = self.refined.bundle.marks[number]
        ends = np.cumsum([len(mark.pixels) for mark in marks.values()])[:-1]
        split = np.split(self.refined.residuals[number], ends)
        return {self.ids[row]: residuals for row, residuals in zip(marks, split, strict=True)}


@dataclass(frozen=True)
class PlacedPhoto:
    """A photo with its camera, or the reason why it has none."""

    sighting: Sighting
    reason: str = ""
    """Why it was left out; "" if it was placed."""
    c2w: Pose | None = None
    """OpenCV frame, metres."""
    reprojection_px: float | None = None
    """Root mean square reprojection error."""
    residuals: dict[int, Float[np.ndarray, "_ 2"]] = field(default_factory=dict)
    """Projected minus seen, pixels, by the tag's id."""
    by: str = ""
    """"texture" if it shows no tag, and was placed against the photos that do; "" if as the others."""

    @property
    def name(self) -> str:
        return self.sighting.name


def relative_poses(sightings: Sequence[Mapping[int, list[Hypothesis]]]) -> dict[tuple[int, int], tuple[Pose, int]]:
    """The motion from one tag's frame to another's that most photos agree on, and how many do.

    Each photo offers all combinations of its tags' solutions; the right ones agree between photos, the flipped do not.
    """
    offers: dict[tuple[int, int], list[list[Pose]]] = defaultdict(list)
    for poses in sightings:
        tags = sorted(tag for tag, found in poses.items() if found)
        for i, a in enumerate(tags):
            for b in tags[i + 1 :]:
                offers[a, b].append([inverse(x.pose) @ y.pose for x in poses[a] for y in poses[b]])
    return {pair: _consensus(photos) for pair, photos in offers.items()}


def _consensus(photos: list[list[Pose]]) -> tuple[Pose, int]:
    """Of all motions the one that most photos agree with, the nearest ones where several do."""
    poses = np.stack([pose for offered in photos for pose in offered])
    turns, shifts = poses[:, :3, :3].reshape(-1, 9), poses[:, :3, 3]
    # |A - B|^2 = 8 sin^2(angle / 2) = 6 - 2 <A, B> for rotations A and B.
    chord = np.sqrt(np.clip(6 - 2 * turns @ turns.T, 0, 8) / 8)
    apart = np.linalg.norm(shifts[:, None] - shifts, axis=2)
    reach = MAX_SHIFT_FRACTION * np.maximum(np.linalg.norm(shifts, axis=1), 1e-9)
    off = np.stack([2 * np.arcsin(chord) / MAX_ANGLE_RAD, apart / reach[:, None]])
    misfit = np.where((off < 1).all(0), off.sum(0), 2.0)
    starts = np.cumsum([0, *(len(offered) for offered in photos)])[:-1]
    nearest = np.minimum.reduceat(misfit, starts, axis=1)
    count = (nearest < 2).sum(1)
    best = np.lexsort((nearest.sum(1), -count))[0]
    return poses[best], int(count[best])


def place_tags(pairs: Mapping[tuple[int, int], tuple[Pose, int]], reference: int) -> dict[int, Pose]:
    """Places all tags that are linked to the reference, starting with the links that most photos agree on.

    Returns:
        Tag to the reference tag's frame.
    """
    placed = {reference: np.eye(4)}
    while True:
        links = [(count, a, b, pose) for (a, b), (pose, count) in pairs.items() if (a in placed) != (b in placed)]
        if not links:
            return placed
        _, a, b, pose = max(links, key=lambda link: (link[0], -link[1], -link[2]))
        if a in placed:
            placed[b] = placed[a] @ pose
        else:
            placed[a] = placed[b] @ inverse(pose)


def solve(
    lens: Intrinsics, sightings: Sequence[Sighting], layout: Mapping[int, Pose] | None, free_lens: tuple[str, ...] = ()
) -> Solved:
    """Places photos and tags, and refines everything together.

    Args:
        lens: a first guess, or the calibrated lens.
        sightings: photos in the order taken; those that show no tag linked to the others are not placed.
        layout: tag to world; None solves it from the photos, in the frame of the tag seen most.
        free_lens: parameters of the lens that may change too; see `refine`.

    Raises:
        InputError: no photo can be placed.
    """
    alone = [{tag: mark_poses(lens, mark) for tag, mark in s.marks.items()} for s in sightings]
    counts = Counter(tag for poses in alone for tag, found in poses.items() if found)
    # The smallest id among the most seen, so that the frame does not depend on the order of photos.
    reference = max(sorted(counts), key=counts.__getitem__, default=-1)
    tags = layout if layout is not None else place_tags(relative_poses(alone), reference)
    options = [(s, found) for s in sightings if (found := photo_poses(lens, s.marks, tags))]
    if not options:
        folder = sightings[0].path.parent
        raise InputError(folder, "", "tags that fit no camera", "photos of flat, undamaged tags, of the size given")
    chosen = resolve_flips([found for _, found in options], [points_and_pixels(s.marks, tags)[0] for s, _ in options])
    ids = tuple(sorted({tag for s, _ in options for tag in s.marks if tag in tags}))
    row = {tag: n for n, tag in enumerate(ids)}
    bundle = Bundle(
        lens,
        np.stack([found[c].pose for (_, found), c in zip(options, chosen, strict=True)]),
        np.stack([tags[tag] for tag in ids]),
        [{row[tag]: mark for tag, mark in s.marks.items() if tag in row} for s, _ in options],
        np.zeros(len(ids)),
    )
    fixed = frozenset(row.values()) if layout is not None else frozenset({row[reference]})
    return Solved(select_model(bundle, [free_lens], fixed), tuple(s.name for s, _ in options), ids, fixed)


def select_model(bundle: Bundle, models: Sequence[tuple[str, ...]], fixed: frozenset[int]) -> Refined:
    """Refines with each lens model and takes the one of lowest BIC whose lens does not fold the picture; then the same with
    twisted tags.

    Parameters that a model does not free have their plain value; a model that frees none keeps the lens.
    """
    fits: list[Refined] = []
    for free in models:
        start = fits[-1].bundle if fits else bundle  # models grow: each starts where the one before ended
        fits.append(refine(replace(start, lens=simplified(start.lens, free)), free, fixed))
    # A polynomial fitted only to the middle of the picture may turn back; the plainest model is the fallback.
    sound = [fit for fit in fits if fit.bundle.lens.sees_every_pixel()] or fits[:1]
    best = min(sound, key=lambda fit: fit.bic)
    twisted = refine(best.bundle, models[fits.index(best)], fixed, free_twists=True)
    return min(best, twisted, key=lambda fit: fit.bic)


def solve_without_misfits(
    sightings: Sequence[Sighting],
    wrong: Mapping[str, str],
    fit: Callable[[Sequence[Sighting]], Solved],
    min_photos: int = 1,
) -> tuple[Solved, list[PlacedPhoto]]:
    """Solves again without the photos and marks that contradict the others, until none does or too few photos are left.

    Args:
        sightings: in the order taken.
        wrong: why photos are left out from the start, by name.
        fit: solves for some of the photos.
        min_photos: that are enough to go on.

    Returns:
        The solution, and all photos.
    """
    reasons = {s.name: "no tag found" for s in sightings if not s.marks} | dict(wrong)
    left = [s for s in sightings if s.name not in reasons]
    while True:
        solved = fit(left)
        kept, off = drop_misfits(solved, left)
        if len(kept) < min_photos or (not off and all(a is b for a, b in zip(kept, left, strict=True))):
            break
        left, reasons = kept, reasons | off
    used, w2c = {s.name: s for s in left}, solved.w2c
    photos = []
    for sighting in sightings:
        name = sighting.name
        if name in w2c:
            residuals = solved.residuals_of(name)
            error = rms_length(np.concatenate(list(residuals.values())))
            photos.append(PlacedPhoto(used[name], "", inverse(w2c[name]), error, residuals))
        else:
            unlinked = "its tags are not linked to those of the other photos"
            photos.append(PlacedPhoto(sighting, reasons.get(name, unlinked)))
    return solved, photos


def drop_misfits(solved: Solved, sightings: Sequence[Sighting]) -> tuple[list[Sighting], dict[str, str]]:
    """Leaves out what is off by far more than the rest: a tag that is half hidden, bent, or mistaken for another; and a photo
    more than half of whose tags are.

    Returns:
        The sightings that are left, and why each photo was left out, by name.
    """
    errors = solved.refined.rms
    median, side = float(np.median(errors)), max(solved.lens.width, solved.lens.height)
    limit = max(OUTLIER_RATIO * median, MIN_OUTLIER_PX * side / 1000)
    reasons, hidden = {}, {}
    for i in np.flatnonzero(errors > limit).tolist():
        name = solved.photos[i]
        by_mark = {tag: rms_length(rest) for tag, rest in solved.residuals_of(name).items()}
        if 2 * sum(error > limit for error in by_mark.values()) > len(by_mark):
            reasons[name] = f"reprojection error {errors[i]:.1f} pixels (median {median:.2f} pixels)"
        else:
            hidden[name] = max(by_mark, key=by_mark.__getitem__)
            text = "%s: tag %d is ignored: it lies elsewhere than in the other photos, or is half hidden"
            log.warning(text, name, hidden[name])
    kept = [s for s in sightings if s.name not in reasons]
    for i, s in enumerate(kept):
        if s.name in hidden:
            kept[i] = replace(s, marks={tag: mark for tag, mark in s.marks.items() if tag != hidden[s.name]})
    return kept, reasons
