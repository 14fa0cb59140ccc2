"""Whether photos and cameras belong together, by the matches between photos: wrong conventions, orders and units are named."""

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int

from nerf_lightning.cameras import Cameras, Lenses, has_panoramas, in_other_frame
from nerf_lightning.dataset.evidence import MAX_TRAIN_PHOTOS, MAX_VAL_PHOTOS, Pair, find_pairs, verified
from nerf_lightning.dataset.hypotheses import ZOOMS, Hypothesis, Matches, convention_hypotheses, explained
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.views import Runs, Views
from nerf_lightning.utils.text import join_truncated, subsample

MIN_PAIRS, MIN_MATCHES = 4, 60
"""That say anything."""
MIN_SHARE, MAX_GAP = 0.1, 0.4
"""Share of the matches that cameras must explain to be believed, and by how much less it may be than what epipolar geometries
of any cameras explain: with few matches these agree with wrong ones too."""
MIN_DEVIATIONS = 6.0
"""Standard deviations by which it must exceed what shuffled poses explain."""
REFUTED, DOUBTED = 0.5, 0.75
"""Share of what another hypothesis explains, below which the cameras given are refuted, and doubted."""
NEARLY = 0.98
"""Hypotheses that explain this share of the best one's matches are as good: the first counts."""
FINE_TOLERANCE = 1 / 3
"""Of the usual one: around a subject that is small beside its distance, wrong focal lengths nearly fit."""
UNRELATED_TOLERANCE = 5.0
"""Likewise: poses that are off by a few degrees are inexact, not unrelated."""
MIN_VIEW_MATCHES, MAX_NAMES = 24, 5
"""Of a photo, for it to be blamed alone; and names in a message."""
RARE = 0.85
"""What a rare mistake's explanation counts for: among many hypotheses some nearly fit photos taken side by side."""
SHUFFLES = 8
SURE = 0.65
"""Share of all matches that agree on epipolar geometries, from which on the cameras are to blame if they do not explain them:
repeated patterns and bare walls have wrong ones."""
MANY_PAIRS = 15
"""That make it doubtful without such certainty."""
UNRELATED, INEXACT = 0.15, 0.5
"""Share of what shuffled poses leave unexplained, below which cameras are unrelated to the photos, and inexact."""
HELD_OUT = 0.35
"""Share of how well training photos fit, below which held-out ones do not."""


@dataclass(frozen=True)
class Doubt:
    """A problem with the data that will spoil the result."""

    text: str
    todo: str = "see the file's convention"
    hopeless: bool = False
    """Whether training cannot work at all."""
    inexact: bool = False
    """Whether correcting the poses may help."""
    far_off: bool = False
    """Whether it is certain that they are wrong."""


def judge_cameras(scene: Scene) -> tuple[list[Doubt], bool]:
    """Compares the cameras of a scene, and what people often mistake them for, with matches between its photos.

    Without enough matches, as between tiny or plain photos, nothing is found and nothing is confirmed; nor is it of photos
    of all directions.

    Returns:
        What matches say against the cameras, and whether they confirm the poses: then no look at their geometry is needed.
    """
    if has_panoramas(scene.train.cameras):
        return [], False
    train, val = subsample(len(scene.train), MAX_TRAIN_PHOTOS), subsample(len(scene.val), MAX_VAL_PHOTOS)
    views = join_views(scene.train[torch.tensor(train)], scene.val[torch.tensor(val, dtype=torch.long)])
    every = in_other_frame(torch.cat([scene.train.cameras.c2w, scene.val.cameras.c2w]), scene.to_source).numpy()
    kept = np.array([*train, *(len(scene.train) + i for i in val)])
    c2w = every[kept]
    pairs = find_pairs(views)
    trained = [pair for pair in pairs if max(pair.first, pair.second) < len(train)]
    tested = [pair for pair in pairs if max(pair.first, pair.second) >= len(train)]
    if not has_evidence(trained):
        return [], False
    matches = Matches.of(trained, views.cameras)
    given = share_explained(matches, c2w)
    longest = int(views.cameras.sizes.max())
    free = float(np.concatenate([verified(pair, longest) for pair in trained]).mean())
    zoomed = focal_hypothesis(matches, c2w, float(views.cameras.K[:, 0, 0].median()))
    chance = needed = 0.0
    doubt = None
    if given < DOUBTED:
        shuffled = shuffled_shares(matches, c2w, len(train))
        chance = float(shuffled.mean())
        needed = max(chance + MIN_DEVIATIONS * float(shuffled.std()), MIN_SHARE, free - MAX_GAP)
        hypotheses = [*convention_hypotheses(c2w), *order_hypotheses(scene, every, kept), zoomed]
        doubt = wrong_convention(matches, given, needed, hypotheses)
    doubt = doubt or wrong_focal(matches, c2w, zoomed, free)
    if doubt is None and given < DOUBTED and free >= SURE:
        doubt = wrong_poses(matches, c2w, len(train))
    elif doubt is None and given < needed and len(trained) >= MANY_PAIRS:
        found = f"poses that explain {given:.0%} of the matches between photos, shuffled ones {chance:.0%}"
        doubt = Doubt(found, "check which pose belongs to which photo", inexact=True)
    if doubt is not None or given < needed:
        return ([] if doubt is None else [doubt]), False
    if given >= REFUTED and (lost := misplaced(matches, c2w, HELD_OUT * given)):
        named = join_truncated([scene.train.name(train[view]) for view in lost], MAX_NAMES)
        return [
            Doubt(f"{len(lost)} training photos whose poses do not fit the others: {named}", "", inexact=True)
        ], True
    if not has_evidence(tested):
        return [], True
    held_out = share_explained(Matches.of(tested, views.cameras), c2w)
    if held_out - chance >= HELD_OUT * (given - chance):
        return [], True
    found = f"held-out photos whose poses explain {held_out:.0%} of the matches, those of training photos {given:.0%}"
    # Where few matches are right, those of a few held-out photos may all be wrong.
    is_sure = given >= REFUTED
    return [Doubt(found, "check which photos and poses each split has", is_sure, True, is_sure)], True


def has_evidence(pairs: Sequence[Pair]) -> bool:
    """Whether there are enough matches to say anything."""
    return len(pairs) >= MIN_PAIRS and sum(len(pair.places) for pair in pairs) >= MIN_MATCHES


def focal_hypothesis(matches: Matches, c2w: Float[np.ndarray, "V 4 4"], focal: float) -> Hypothesis:
    """The focal length that explains most matches, other than that as read, in pixels."""
    shares = np.array([share_explained(matches, c2w, zoom, FINE_TOLERANCE) for zoom in ZOOMS])
    alike = np.array(ZOOMS)[shares >= NEARLY * shares.max()]
    zoom = float(np.exp(np.log(alike).mean()))
    todo = "is it in millimetres, or of reduced photos?" if zoom > 1 else "is it that of larger photos?"
    return Hypothesis(
        f"a focal length of {focal:.4g} pixels, where about {zoom * focal:.2g} would fit", todo, c2w, zoom
    )


def wrong_focal(matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoomed: Hypothesis, free: float) -> Doubt | None:
    """Another focal length, if it explains clearly more.

    Args:
        matches, c2w: see `explained`.
        zoomed: has it.
        free: share of the matches that agree on epipolar geometries.
    """
    given, share = (share_explained(matches, c2w, zoom, FINE_TOLERANCE) for zoom in (1.0, zoomed.zoom))
    deviation = np.sqrt(share / len(matches.pair))
    least = max(MIN_SHARE, free - MAX_GAP, given + MIN_DEVIATIONS * deviation)
    return None if share < least else refuted(zoomed, share, given)


def wrong_convention(matches: Matches, given: float, needed: float, hypotheses: Iterable[Hypothesis]) -> Doubt | None:
    """The first of the hypotheses that explain matches best, if it explains what the cameras as read do not."""
    best, quality = None, 0.0
    for hypothesis in hypotheses:
        # The finer tolerance decides between hypotheses that are nearly the same over the angles of these photos.
        slacks = (1.0, FINE_TOLERANCE)
        one = sum(share_explained(matches, hypothesis.c2w, hypothesis.zoom, slack) for slack in slacks)
        one *= RARE if hypothesis.rare else 1.0
        if one * NEARLY > quality:
            best, quality = hypothesis, one
    share = 0.0 if best is None else share_explained(matches, best.c2w, best.zoom)
    return None if best is None or share < needed else refuted(best, share, given)


def refuted(hypothesis: Hypothesis, share: float, given: float) -> Doubt | None:
    """That the cameras as read explain too little beside a hypothesis, if they do."""
    if given >= DOUBTED * share:
        return None
    found = (
        f"{hypothesis.found}: that explains {share:.0%} of the matches between photos, the cameras as read {given:.0%}"
    )
    return Doubt(found, hypothesis.todo, given < REFUTED * share)


def wrong_poses(matches: Matches, c2w: Float[np.ndarray, "V 4 4"], count: int) -> Doubt | None:
    """Poses that explain little more than those of other photos would."""
    strict, loose = (
        (share_explained(matches, c2w, tolerance=slack), shuffled_shares(matches, c2w, count, slack).mean())
        for slack in (1.0, UNRELATED_TOLERANCE)
    )
    skill, loose_skill = ((given - chance) / (1 - chance) for given, chance in (strict, loose))
    if skill >= INEXACT:
        return None
    found = (
        f"poses that explain {strict[0]:.0%} of the matches between photos, while shuffled ones explain {strict[1]:.0%}:"
        " they belong to other photos, or are inexact"
    )
    unrelated = bool(loose_skill < UNRELATED)
    return Doubt(found, "check which pose belongs to which photo", unrelated, True, unrelated)


def misplaced(matches: Matches, c2w: Float[np.ndarray, "V 4 4"], least: float) -> list[int]:
    """Views that have enough matches, of which the cameras explain less than a share."""
    right, count = np.zeros(len(c2w)), np.zeros(len(c2w))
    for side in (0, 1):
        view = matches.views[matches.pair, side]
        right += np.bincount(view, explained(matches, c2w), len(c2w))
        count += np.bincount(view, minlength=len(c2w))
    return np.flatnonzero((count >= MIN_VIEW_MATCHES) & (right < least * count)).tolist()


def share_explained(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoom: float = 1.0, tolerance: float = 1.0
) -> float:
    """Share of the matches that cameras allow."""
    return float(explained(matches, c2w, zoom, tolerance).mean())


def order_hypotheses(scene: Scene, c2w: Float[np.ndarray, "V 4 4"], kept: Int[np.ndarray, "K"]) -> Iterator[Hypothesis]:
    """Poses in another order than the photos."""
    names = [*scene.train.names, *scene.val.names]
    count = len(names) or len(scene.train)
    alphabetical = np.array(sorted(range(count), key=lambda i: names[i])) if names else np.arange(count)
    numeric = np.array(sorted(range(count), key=lambda i: numeric_key(names[i]))) if names else alphabetical

    def reorder(source: Int[np.ndarray, "V"], target: Int[np.ndarray, "V"]) -> Float[np.ndarray, "K 4 4"]:
        moved = c2w.copy()
        moved[target] = c2w[source]
        return moved[kept]

    todo = "give each photo its own pose"
    for order in (alphabetical, numeric):
        for step, where in ((1, "before"), (-1, "after")):
            # Read: each photo has the pose of the one before it; so its own is at the next.
            found = f"poses that are those of the photos {where} them in the order of names"
            yield Hypothesis(found, todo, reorder(np.roll(order, -step), order))
        yield Hypothesis("poses in the reverse order of the photos", todo, reorder(order[::-1], order))
    if (alphabetical != numeric).any():
        found = (
            "poses in another order than the photos, whose names sort otherwise as numbers (2, 10) than as text (10, 2)"
        )
        yield Hypothesis(found, todo, reorder(alphabetical, numeric))
        yield Hypothesis(found, todo, reorder(numeric, alphabetical))


def numeric_key(name: str) -> list[tuple[int, str]]:
    """Sorts numbers in a name by their value."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def shuffled_shares(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], count: int, tolerance: float = 1.0
) -> Float[np.ndarray, "S"]:
    """Shares of the matches that the first `count` cameras explain in random orders."""
    generator = np.random.default_rng(0)
    orders = [generator.permutation(count) for _ in range(SHUFFLES)]
    return np.array([share_explained(matches, c2w[order], tolerance=tolerance) for order in orders])


def join_views(first: Views, second: Views) -> Views:
    """The photos of both, without names."""
    both = (first.cameras, second.cameras)
    K, c2w, sizes = (torch.cat([getattr(cameras, key) for cameras in both]) for key in ("K", "c2w", "sizes"))
    bent = None
    if all(cameras.lenses is not None for cameras in both):
        bent = Lenses(*(torch.cat([getattr(x.lenses, key) for x in both]) for key in ("coefficients", "projection")))
    masked = first.known is not None or second.known is not None
    known = Runs.of(torch.cat([first.mask, second.mask])) if masked else None
    channels = min(first.channels, second.channels)  # one of them may have alpha
    pixels = torch.cat([views.pixels[:, :channels] for views in (first, second)])
    return Views(pixels, Cameras(K, c2w, sizes, bent), known)
