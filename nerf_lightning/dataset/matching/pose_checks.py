"""Whether photos and cameras belong together, by the matches between photos: wrong conventions, orders and units are named."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from nerf_lightning.cameras import Cameras, Lenses, has_panoramas, transform_poses
from nerf_lightning.dataset.matching.epipolar import Matches, compute_inlier_ratio, find_inliers
from nerf_lightning.dataset.matching.features import Pair, compute_ransac_inlier_ratio, detect_features, find_pairs
from nerf_lightning.dataset.matching.hypotheses import Hypothesis, Poses, list_conventions, list_orders
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.utils.text import join_truncated, subsample

MAX_TRAIN_PHOTOS, MAX_VAL_PHOTOS = 48, 8
"""Photos that are matched, evenly chosen."""
FOCAL_FACTORS = tuple(2.0 ** (step / 8) for step in range(-32, 57) if step)
"""Focal lengths that are tried, in those given: lenses in millimetres are up to a hundred times too short."""
MIN_PAIRS, MIN_MATCHES = 4, 60
"""That say anything."""
MIN_INLIER_RATIO, MAX_INLIER_GAP = 0.1, 0.4
"""Share of the matches that cameras must explain to be believed, and by how much less it may be than what epipolar geometries
of any cameras explain: with few matches these agree with wrong ones too."""
MIN_OUTLIER_DEVIATIONS = 6.0
"""Standard deviations by which it must exceed what shuffled poses explain."""
MAX_REFUTED_RATIO, MAX_DOUBTED_RATIO = 0.5, 0.75
"""Share of what another hypothesis explains, below which the cameras given are refuted, and doubted."""
TIE_RATIO = 0.98
"""Hypotheses that explain this share of the best one's matches are as good: the first counts."""
FINE_TOLERANCE = 1 / 3
"""Of the usual one: around a subject that is small beside its distance, wrong focal lengths nearly fit."""
UNRELATED_TOLERANCE = 5.0
"""Likewise: poses that are off by a few degrees are inexact, not unrelated."""
MIN_VIEW_MATCHES, MAX_NAMES = 24, 5
"""Of a photo, for it to be blamed alone; and names in a message."""
RARE_PENALTY = 0.85
"""What a rare mistake's explanation counts for: among many hypotheses some nearly fit photos taken side by side."""
NUM_SHUFFLES = 8
MIN_RANSAC_INLIER_RATIO = 0.65
"""Share of all matches that agree on epipolar geometries, from which on the cameras are to blame if they do not explain them:
repeated patterns and bare walls have wrong ones."""
MIN_UNCERTAIN_PAIRS = 15
"""That make it doubtful without such certainty."""
MAX_UNRELATED_SKILL, MAX_INEXACT_SKILL = 0.15, 0.5
"""Share of what shuffled poses leave unexplained, below which cameras are unrelated to the photos, and inexact."""
MIN_HELD_OUT_RATIO = 0.35
"""Share of how well training photos fit, below which held-out ones do not."""


@dataclass(frozen=True)
class SceneIssue:
    """A problem with the data that will spoil the result."""

    text: str
    hint: str = "see the file's convention"
    is_fatal: bool = False
    """Whether training cannot work at all."""
    is_refinable: bool = False
    """Whether correcting the poses may help."""
    has_wrong_poses: bool = False
    """Whether it is certain that they are wrong."""


def compare_with_matches(scene: Scene) -> tuple[list[SceneIssue], bool]:
    """Compares the cameras of a scene, and what people often mistake them for, with matches between its photos.

    Without enough matches, as between tiny or plain photos, nothing is found and nothing is confirmed; nor is it of photos
    of all directions.

    Returns:
        What matches say against the cameras, and whether they confirm the poses: then no look at their geometry is needed.
    """
    if has_panoramas(scene.train.cameras):
        return [], False
    train, val = subsample(len(scene.train), MAX_TRAIN_PHOTOS), subsample(len(scene.val), MAX_VAL_PHOTOS)
    parts = [(scene.train, train), (scene.val, val)]
    cameras = join_cameras(*(views.cameras[torch.tensor(some, dtype=torch.long)] for views, some in parts))
    pairs = find_pairs([detect_features(views, view) for views, some in parts for view in some], cameras)
    trained = [pair for pair in pairs if max(pair.first, pair.second) < len(train)]
    if not has_enough_matches(trained):
        return [], False
    matches = Matches.from_pairs(trained, cameras)
    every = transform_poses(torch.cat([scene.train.cameras.c2w, scene.val.cameras.c2w]), scene.to_source).numpy()
    kept = np.array([*train, *(len(scene.train) + i for i in val)])
    c2w = every[kept]
    given, free = compute_inlier_ratio(matches, c2w), compute_ransac_inlier_ratio(trained, int(cameras.sizes.max()))
    chance, needed = 0.0, 0.0
    zoomed = fit_focal(matches, c2w, float(cameras.K[:, 0, 0].median()))
    doubt = None
    if given < MAX_DOUBTED_RATIO:
        shuffled = compute_shuffled_ratios(matches, c2w, len(train))
        chance = float(shuffled.mean())
        needed = max(chance + MIN_OUTLIER_DEVIATIONS * float(shuffled.std()), MIN_INLIER_RATIO, free - MAX_INLIER_GAP)
        names = [*scene.train.names, *scene.val.names] or [f"{i:06}" for i in range(len(scene.train))]
        best, ratio = choose_best_hypothesis(
            matches, [*list_conventions(c2w), *list_orders(names, every, kept), zoomed]
        )
        doubt = compare_hypothesis(best, ratio, given, needed)
    if doubt is None:
        fine, ratio = (compute_inlier_ratio(matches, c2w, zoom, FINE_TOLERANCE) for zoom in (1.0, zoomed.zoom))
        deviation = float(np.sqrt(ratio / len(matches.pair)))
        doubt = compare_hypothesis(
            zoomed, ratio, fine, max(MIN_INLIER_RATIO, free - MAX_INLIER_GAP, fine + MIN_OUTLIER_DEVIATIONS * deviation)
        )
    if doubt is None and given < MAX_DOUBTED_RATIO and free >= MIN_RANSAC_INLIER_RATIO:
        doubt = find_wrong_poses(matches, c2w, len(train))
    elif doubt is None and given < needed and len(trained) >= MIN_UNCERTAIN_PAIRS:
        found = f"poses that explain {given:.0%} of the matches between photos, shuffled ones {chance:.0%}"
        doubt = SceneIssue(found, "check which pose belongs to which photo", is_refinable=True)
    if doubt is not None or given < needed:
        return ([] if doubt is None else [doubt]), False
    if given >= MAX_REFUTED_RATIO and (lost := find_inconsistent_views(matches, c2w, MIN_HELD_OUT_RATIO * given)):
        named = join_truncated([scene.train.name(train[view]) for view in lost], MAX_NAMES)
        found = f"{len(lost)} training photos whose poses do not fit the others: {named}"
        return [SceneIssue(found, "", is_refinable=True)], True
    tested = [pair for pair in pairs if max(pair.first, pair.second) >= len(train)]
    held_out = compute_inlier_ratio(Matches.from_pairs(tested, cameras), c2w) if has_enough_matches(tested) else given
    if held_out - chance >= MIN_HELD_OUT_RATIO * (given - chance):
        return [], True
    found = f"held-out photos whose poses explain {held_out:.0%} of the matches, those of training photos {given:.0%}"
    # Where few matches are right, those of a few held-out photos may all be wrong.
    is_sure = given >= MAX_REFUTED_RATIO
    return [SceneIssue(found, "check which photos and poses each split has", is_sure, True, is_sure)], True


def join_cameras(first: Cameras, second: Cameras) -> Cameras:
    K, c2w, sizes = (torch.cat([getattr(one, key) for one in (first, second)]) for key in ("K", "c2w", "sizes"))
    lenses = [one.lenses for one in (first, second) if one.lenses is not None]
    if len(lenses) < 2:
        return Cameras(K, c2w, sizes)
    joined = (torch.cat([getattr(one, key) for one in lenses]) for key in ("coefficients", "projection"))
    return Cameras(K, c2w, sizes, Lenses(*joined))


def has_enough_matches(pairs: Sequence[Pair]) -> bool:
    """Whether there are enough matches to say anything."""
    return len(pairs) >= MIN_PAIRS and sum(len(pair.keypoints) for pair in pairs) >= MIN_MATCHES


def fit_focal(matches: Matches, c2w: Poses, focal: float) -> Hypothesis:
    """The focal length that explains most matches, other than that as read, in pixels."""
    shares = np.array([compute_inlier_ratio(matches, c2w, zoom, FINE_TOLERANCE) for zoom in FOCAL_FACTORS])
    alike = np.array(FOCAL_FACTORS)[shares >= TIE_RATIO * shares.max()]
    zoom = float(np.exp(np.log(alike).mean()))
    hint = "is it in millimetres, or of reduced photos?" if zoom > 1 else "is it that of larger photos?"
    found = f"a focal length of {focal:.4g} pixels, where about {zoom * focal:.2g} would fit"
    return Hypothesis(found, hint, c2w, zoom)


def choose_best_hypothesis(matches: Matches, hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, float]:
    """The first of the hypotheses that explain matches best, and the share that it explains."""
    best, ratio, quality = hypotheses[0], 0.0, 0.0
    for hypothesis in hypotheses:
        # The finer tolerance decides between hypotheses that are nearly the same over the angles of these photos.
        coarse, fine = (
            compute_inlier_ratio(matches, hypothesis.c2w, hypothesis.zoom, slack) for slack in (1.0, FINE_TOLERANCE)
        )
        score = (coarse + fine) * (RARE_PENALTY if hypothesis.is_rare else 1.0)
        if score * TIE_RATIO > quality:
            best, ratio, quality = hypothesis, coarse, score
    return best, ratio


def compare_hypothesis(hypothesis: Hypothesis, ratio: float, given: float, min_ratio: float) -> SceneIssue | None:
    """That the cameras as read explain too little beside a hypothesis, if they do, and it explains at least so much."""
    if ratio < min_ratio or given >= MAX_DOUBTED_RATIO * ratio:
        return None
    explained = f"that explains {ratio:.0%} of the matches between photos, the cameras as read {given:.0%}"
    return SceneIssue(f"{hypothesis.fault}: {explained}", hypothesis.hint, given < MAX_REFUTED_RATIO * ratio)


def find_wrong_poses(matches: Matches, c2w: Poses, count: int) -> SceneIssue | None:
    """Poses that explain little more than those of other photos would."""
    slacks = (1.0, UNRELATED_TOLERANCE)
    given = np.array([compute_inlier_ratio(matches, c2w, tolerance=slack) for slack in slacks])
    chance = np.array([compute_shuffled_ratios(matches, c2w, count, slack).mean() for slack in slacks])
    skill, loose_skill = (given - chance) / (1 - chance)
    if skill >= MAX_INEXACT_SKILL:
        return None
    explained = f"poses that explain {given[0]:.0%} of the matches between photos, while shuffled ones explain"
    found = f"{explained} {chance[0]:.0%}: they belong to other photos, or are inexact"
    unrelated = bool(loose_skill < MAX_UNRELATED_SKILL)
    return SceneIssue(found, "check which pose belongs to which photo", unrelated, True, unrelated)


def compute_shuffled_ratios(matches: Matches, c2w: Poses, count: int, tolerance: float = 1.0) -> Float[np.ndarray, "S"]:
    """Shares of the matches that the first `count` cameras explain in random orders."""
    generator = np.random.default_rng(0)
    orders = [generator.permutation(count) for _ in range(NUM_SHUFFLES)]
    return np.array([compute_inlier_ratio(matches, c2w[order], tolerance=tolerance) for order in orders])


def find_inconsistent_views(matches: Matches, c2w: Poses, min_ratio: float) -> list[int]:
    """Views that have enough matches, of which the cameras explain less than a share."""
    views = matches.views[matches.pair].T.ravel()
    right = np.bincount(views, np.tile(find_inliers(matches, c2w), 2), len(c2w))
    count = np.bincount(views, minlength=len(c2w))
    return np.flatnonzero((count >= MIN_VIEW_MATCHES) & (right < min_ratio * count)).tolist()
