"""Pose checks by feature matches between photos: detect wrong conventions, orders and focal lengths."""

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
"""Matched photos, evenly spaced."""
FOCAL_FACTORS = tuple(2.0 ** (step / 8) for step in range(-32, 57) if step)
"""Focal lengths tried, relative to the file's: values in millimeters are up to a hundred times too short."""
MIN_PAIRS, MIN_MATCHES = 4, 60
"""Pairs and matches needed for any conclusion."""
MIN_INLIER_RATIO, MAX_INLIER_GAP = 0.1, 0.4
"""Minimum inlier ratio of plausible cameras, and its largest gap to the RANSAC inlier ratio, which few matches inflate."""
MIN_OUTLIER_DEVIATIONS = 6.0
"""Standard deviations by which the inlier ratio must exceed that of shuffled poses."""
MAX_REFUTED_RATIO, MAX_DOUBTED_RATIO = 0.5, 0.75
"""Inlier ratio relative to the best hypothesis, below which the given cameras are refuted, and doubted."""
TIE_RATIO = 0.98
"""Hypotheses within this factor of the best inlier ratio are tied: the first is taken."""
FINE_TOLERANCE = 1 / 3
"""Relative to the default tolerance: around a small distant subject, wrong focal lengths nearly fit."""
UNRELATED_TOLERANCE = 5.0
"""Relative to the default tolerance: poses off by a few degrees are inexact, not unrelated."""
MIN_VIEW_MATCHES, MAX_NAMES = 24, 5
"""Matches of a photo for an individual verdict, and names in a message."""
RARE_PENALTY = 0.85
"""Score factor of rare mistakes: of many hypotheses some nearly fit photos taken side by side."""
NUM_SHUFFLES = 8
MIN_RANSAC_INLIER_RATIO = 0.65
"""Minimum RANSAC inlier ratio to blame the cameras: repeated patterns and bare walls give wrong matches."""
MIN_UNCERTAIN_PAIRS = 15
"""Pairs needed to doubt the poses below that ratio."""
MAX_UNRELATED_SKILL, MAX_INEXACT_SKILL = 0.15, 0.5
"""Skill, (ratio - chance) / (1 - chance), below which cameras are unrelated to the photos, and inexact."""
MIN_HELD_OUT_RATIO = 0.35
"""Minimum inlier ratio of held-out photos, relative to training photos."""


@dataclass(frozen=True)
class SceneIssue:
    """Problem with the data that will degrade the result."""

    text: str
    hint: str = "see the file's convention"
    is_fatal: bool = False
    """Whether training cannot succeed."""
    is_refinable: bool = False
    """Whether pose refinement may help."""
    has_wrong_poses: bool = False
    """Whether the poses are certainly wrong."""


def compare_with_matches(scene: Scene) -> tuple[list[SceneIssue], bool]:
    """Compares the cameras of a scene, and hypotheses of common mistakes, with feature matches.

    Inconclusive (no issue, not confirmed) for panoramas and with too few matches, as between tiny or textureless photos.

    Returns:
        The issues, and whether matches confirm the poses.
    """
    if has_panoramas(scene.train.cameras):
        return [], False
    train, val = subsample(len(scene.train), MAX_TRAIN_PHOTOS), subsample(len(scene.val), MAX_VAL_PHOTOS)
    parts = [(scene.train, train), (scene.val, val)]
    cameras = join_cameras(*(views.cameras[torch.tensor(part, dtype=torch.long)] for views, part in parts))
    pairs = find_pairs([detect_features(views, view) for views, part in parts for view in part], cameras)
    train_pairs = [pair for pair in pairs if max(pair.first, pair.second) < len(train)]
    if not has_enough_matches(train_pairs):
        return [], False
    matches = Matches.from_pairs(train_pairs, cameras)
    all_c2w = transform_poses(torch.cat([scene.train.cameras.c2w, scene.val.cameras.c2w]), scene.to_source).numpy()
    indices = np.array([*train, *(len(scene.train) + i for i in val)])
    c2w = all_c2w[indices]
    given = compute_inlier_ratio(matches, c2w)
    ransac = compute_ransac_inlier_ratio(train_pairs, int(cameras.sizes.max()))
    chance, min_ratio = 0.0, 0.0
    zoomed = fit_focal(matches, c2w, float(cameras.K[:, 0, 0].median()))
    issue = None
    if given < MAX_DOUBTED_RATIO:
        shuffled = compute_shuffled_ratios(matches, c2w, len(train))
        chance = float(shuffled.mean())
        significant = chance + MIN_OUTLIER_DEVIATIONS * float(shuffled.std())
        min_ratio = max(significant, MIN_INLIER_RATIO, ransac - MAX_INLIER_GAP)
        names = [*scene.train.names, *scene.val.names] or [f"{i:06}" for i in range(len(scene.train))]
        hypotheses = [*list_conventions(c2w), *list_orders(names, all_c2w, indices), zoomed]
        best, ratio = choose_best_hypothesis(matches, hypotheses)
        issue = compare_hypothesis(best, ratio, given, min_ratio)
    if issue is None:
        fine, ratio = (compute_inlier_ratio(matches, c2w, zoom, FINE_TOLERANCE) for zoom in (1.0, zoomed.zoom))
        deviation = float(np.sqrt(ratio / len(matches.pair)))
        min_fine = max(MIN_INLIER_RATIO, ransac - MAX_INLIER_GAP, fine + MIN_OUTLIER_DEVIATIONS * deviation)
        issue = compare_hypothesis(zoomed, ratio, fine, min_fine)
    if issue is None and given < MAX_DOUBTED_RATIO and ransac >= MIN_RANSAC_INLIER_RATIO:
        issue = find_wrong_poses(matches, c2w, len(train))
    elif issue is None and given < min_ratio and len(train_pairs) >= MIN_UNCERTAIN_PAIRS:
        text = f"poses that explain {given:.0%} of the matches between photos, shuffled ones {chance:.0%}"
        issue = SceneIssue(text, "check which pose belongs to which photo", is_refinable=True)
    if issue is not None or given < min_ratio:
        return ([] if issue is None else [issue]), False
    if given >= MAX_REFUTED_RATIO and (outliers := find_inconsistent_views(matches, c2w, MIN_HELD_OUT_RATIO * given)):
        named = join_truncated([scene.train.name(train[view]) for view in outliers], MAX_NAMES)
        text = f"{len(outliers)} training photos whose poses do not fit the others: {named}"
        return [SceneIssue(text, "", is_refinable=True)], True
    val_pairs = [pair for pair in pairs if max(pair.first, pair.second) >= len(train)]
    val_matches = Matches.from_pairs(val_pairs, cameras) if has_enough_matches(val_pairs) else None
    held_out = given if val_matches is None else compute_inlier_ratio(val_matches, c2w)
    if held_out - chance >= MIN_HELD_OUT_RATIO * (given - chance):
        return [], True
    text = f"held-out photos whose poses explain {held_out:.0%} of the matches, those of training photos {given:.0%}"
    # With few correct matches, those of a few held-out photos may all be wrong.
    is_certain = given >= MAX_REFUTED_RATIO
    return [SceneIssue(text, "check which photos and poses each split has", is_certain, True, is_certain)], True


def join_cameras(first: Cameras, second: Cameras) -> Cameras:
    K, c2w, sizes = (torch.cat([getattr(first, key), getattr(second, key)]) for key in ("K", "c2w", "sizes"))
    lenses = [cameras.lenses for cameras in (first, second) if cameras.lenses is not None]
    if len(lenses) < 2:
        return Cameras(K, c2w, sizes)
    joined = (torch.cat([getattr(lens, key) for lens in lenses]) for key in ("coefficients", "projection"))
    return Cameras(K, c2w, sizes, Lenses(*joined))


def has_enough_matches(pairs: Sequence[Pair]) -> bool:
    """Whether there are enough matches for a conclusion."""
    return len(pairs) >= MIN_PAIRS and sum(len(pair.keypoints) for pair in pairs) >= MIN_MATCHES


def fit_focal(matches: Matches, c2w: Poses, focal: float) -> Hypothesis:
    """Hypothesis of another focal length, in pixels: the one with the best inlier ratio."""
    ratios = np.array([compute_inlier_ratio(matches, c2w, zoom, FINE_TOLERANCE) for zoom in FOCAL_FACTORS])
    tied = np.array(FOCAL_FACTORS)[ratios >= TIE_RATIO * ratios.max()]
    zoom = float(np.exp(np.log(tied).mean()))
    hint = "is it in millimeters, or of reduced photos?" if zoom > 1 else "is it that of larger photos?"
    fault = f"a focal length of {focal:.4g} pixels, where about {zoom * focal:.2g} would fit"
    return Hypothesis(fault, hint, c2w, zoom)


def choose_best_hypothesis(matches: Matches, hypotheses: Sequence[Hypothesis]) -> tuple[Hypothesis, float]:
    """Chooses the first of the best hypotheses, and returns it with its inlier ratio."""
    best, ratio, quality = hypotheses[0], 0.0, 0.0
    for h in hypotheses:
        # The finer tolerance separates hypotheses that are nearly equal over the angles of these photos.
        coarse, fine = (compute_inlier_ratio(matches, h.c2w, h.zoom, slack) for slack in (1.0, FINE_TOLERANCE))
        score = (coarse + fine) * (RARE_PENALTY if h.is_rare else 1.0)
        if score * TIE_RATIO > quality:
            best, ratio, quality = h, coarse, score
    return best, ratio


def compare_hypothesis(hypothesis: Hypothesis, ratio: float, given: float, min_ratio: float) -> SceneIssue | None:
    """Returns an issue if a hypothesis reaches `min_ratio` and explains clearly more matches than the cameras as read."""
    if ratio < min_ratio or given >= MAX_DOUBTED_RATIO * ratio:
        return None
    explained = f"that explains {ratio:.0%} of the matches between photos, the cameras as read {given:.0%}"
    return SceneIssue(f"{hypothesis.fault}: {explained}", hypothesis.hint, given < MAX_REFUTED_RATIO * ratio)


def find_wrong_poses(matches: Matches, c2w: Poses, count: int) -> SceneIssue | None:
    """Returns an issue if the poses explain little more than shuffled ones."""
    slacks = (1.0, UNRELATED_TOLERANCE)
    given = np.array([compute_inlier_ratio(matches, c2w, tolerance=slack) for slack in slacks])
    chance = np.array([compute_shuffled_ratios(matches, c2w, count, slack).mean() for slack in slacks])
    skill, loose_skill = (given - chance) / (1 - chance)
    if skill >= MAX_INEXACT_SKILL:
        return None
    explained = f"poses that explain {given[0]:.0%} of the matches between photos, while shuffled ones explain"
    text = f"{explained} {chance[0]:.0%}: they belong to other photos, or are inexact"
    is_unrelated = bool(loose_skill < MAX_UNRELATED_SKILL)
    return SceneIssue(text, "check which pose belongs to which photo", is_unrelated, True, is_unrelated)


def compute_shuffled_ratios(matches: Matches, c2w: Poses, count: int, tolerance: float = 1.0) -> Float[np.ndarray, "S"]:
    """Computes the inlier ratios of the first `count` cameras in random orders."""
    generator = np.random.default_rng(0)
    orders = [generator.permutation(count) for _ in range(NUM_SHUFFLES)]
    return np.array([compute_inlier_ratio(matches, c2w[order], tolerance=tolerance) for order in orders])


def find_inconsistent_views(matches: Matches, c2w: Poses, min_ratio: float) -> list[int]:
    """Finds views with enough matches and an inlier ratio below `min_ratio`."""
    views = matches.views[matches.pair].T.ravel()
    inliers = np.bincount(views, np.tile(find_inliers(matches, c2w), 2), len(c2w))
    count = np.bincount(views, minlength=len(c2w))
    return np.flatnonzero((count >= MIN_VIEW_MATCHES) & (inliers < min_ratio * count)).tolist()
