"""Where the tags lie and where the cameras stood, from the photos alone."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.bundle import Bundle, simplified
from nerf_lightning.capture.poses.flips import resolve_flips
from nerf_lightning.capture.poses.geometry import folds, inverse
from nerf_lightning.capture.poses.pose import Hypothesis, mark_poses, photo_poses, points_and_pixels
from nerf_lightning.capture.poses.refine import Refined, refine, rms_length
from nerf_lightning.capture.tags.detect import Mark
from nerf_lightning.dataset.intrinsics import Intrinsics

Pose = Float[np.ndarray, "4 4"]
AGREE_ANGLE = np.radians(10.0)
"""Two photos say the same of two tags if they differ by less than this angle, and ..."""
AGREE_SHIFT = 0.25
"""... by less than this share of the tags' distance (or of a tag, where they touch)."""
OUTLIER = 4.0
"""A photo is off if its error is more than this times the median, and also above ..."""
OUTLIER_PIXELS = 1.0
"""... this at 1000 pixels along the longest side."""


@dataclass(frozen=True)
class Solved:
    """Cameras and tags in one frame."""

    lens: Intrinsics
    tags: dict[int, Pose]
    """Tag to world."""
    w2c: dict[int, Pose]
    """World to camera, by the photo's number; photos that could not be placed are missing."""
    refined: Refined
    placed: list[int]
    """Numbers of the photos in the order of `refined`."""
    fixed: frozenset[int]
    """Which of the tags, counted in the order of `tags`, hold the world in place."""


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
    reach = AGREE_SHIFT * np.maximum(np.linalg.norm(shifts, axis=1), 1e-9)
    off = np.stack([2 * np.arcsin(chord) / AGREE_ANGLE, apart / reach[:, None]])
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
    lens: Intrinsics, marks: Sequence[dict[int, Mark]], layout: dict[int, Pose] | None, free_lens: tuple[str, ...] = ()
) -> Solved | None:
    """Places photos and tags, and refines everything together.

    Args:
        lens: a first guess, or the calibrated lens.
        marks: by photo, in the order taken.
        layout: tag to world; None solves it from the photos, in the frame of the tag seen most.
        free_lens: parameters of the lens that may change too; see `refine`.

    Returns:
        None where no photo could be placed.
    """
    alone = [{tag: mark_poses(lens, mark) for tag, mark in photo.items()} for photo in marks]
    counts = Counter(tag for poses in alone for tag, found in poses.items() if found)
    if not counts:
        return None
    # The smallest id among the most seen, so that the frame does not depend on the order of photos.
    reference = max(sorted(counts), key=counts.__getitem__)
    tags = layout if layout is not None else place_tags(relative_poses(alone), reference)
    options = {i: photo_poses(lens, photo, tags) for i, photo in enumerate(marks)}
    placed = [i for i, found in options.items() if found]
    if not placed:
        return None
    seen = [points_and_pixels(marks[i], tags) for i in placed]
    chosen = resolve_flips(lens, [options[i] for i in placed], seen)
    w2c = np.stack([options[i][c].pose for i, c in zip(placed, chosen, strict=True)])
    numbers = sorted({tag for i in placed for tag in marks[i] if tag in tags})
    row = {tag: n for n, tag in enumerate(numbers)}
    bundle = Bundle(
        lens,
        w2c,
        np.stack([tags[tag] for tag in numbers]),
        [{row[tag]: mark for tag, mark in marks[i].items() if tag in row} for i in placed],
        np.zeros(len(numbers)),
    )
    fixed = frozenset(row.values()) if layout is not None else frozenset({row[reference]})
    return packed(select_model(bundle, [free_lens], fixed), numbers, placed, fixed)


def select_model(bundle: Bundle, models: Sequence[tuple[str, ...]], fixed: frozenset[int]) -> Refined:
    """Refines with each lens model and takes the one of lowest BIC whose lens does not fold the picture; then the same with
    twisted tags.

    Parameters that a model does not free have their plain value; a model that frees none keeps the lens.
    """
    fits: list[Refined] = []
    for free in models:
        start = fits[-1].bundle if fits else bundle  # models grow: each starts where the one before ended
        fits.append(refine(replace(start, lens=simplified(start.lens, free)), free, fixed))
    # The plainest model is the fallback.
    sound = [fit for fit in fits if not folds(fit.bundle.lens)] or fits[:1]
    best = min(sound, key=lambda fit: fit.bic)
    twisted = refine(best.bundle, models[fits.index(best)], fixed, free_twists=True)
    return min(best, twisted, key=lambda fit: fit.bic)


@dataclass(frozen=True)
class Misfits:
    """What the other photos contradict."""

    photos: dict[int, float]
    """Numbers of photos more than half of whose marks are off, by how many pixels."""
    marks: dict[int, int]
    """The worst tag, by the number of the photo, where others are sound."""
    usual: float
    """Median over photos, pixels."""


def misfits(solved: Solved) -> Misfits:
    """Photos that are off by far more than the others: a tag half hidden, bent, or mistaken for another."""
    rms, tags = solved.refined.rms, list(solved.tags)
    usual, side = float(np.median(rms)), max(solved.lens.width, solved.lens.height)
    limit = max(OUTLIER * usual, OUTLIER_PIXELS * side / 1000)
    photos, marks = {}, {}
    for i in np.flatnonzero(rms > limit).tolist():
        by_mark = {tag: rms_length(rest) for tag, rest in solved.refined.by_mark(i).items()}
        if 2 * sum(error > limit for error in by_mark.values()) > len(by_mark):
            photos[solved.placed[i]] = float(rms[i])
        else:
            marks[solved.placed[i]] = tags[max(by_mark, key=by_mark.__getitem__)]
    return Misfits(photos, marks, usual)


def packed(refined: Refined, tags: Sequence[int], placed: Sequence[int], fixed: frozenset[int]) -> Solved:
    """A refined bundle with its tags' ids and its photos' numbers."""
    bundle = refined.bundle
    return Solved(
        bundle.lens,
        dict(zip(tags, bundle.tags, strict=True)),
        dict(zip(placed, bundle.w2c, strict=True)),
        refined,
        list(placed),
        fixed,
    )
