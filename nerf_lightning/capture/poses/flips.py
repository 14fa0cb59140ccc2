"""Resolves the two-fold ambiguity of planar poses by the order in which photos were taken.

A planar tag seen nearly head-on has two poses of about the same reprojection error, and noise decides between them. But
viewing directions change little between consecutive photos: each photo's direction is predicted as the weighted mean of its
neighbors', iteratively, and the spread of the prediction errors sets the prior's weight. Unordered photos predict each other
badly and keep their best pose.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import invert_pose
from nerf_lightning.capture.poses.planar_pnp import Hypothesis

NEIGHBOR_STD_PHOTOS = 1.5, 2.0, 3.0
"""Standard deviations, in photos, of the neighbors' Gaussian weights; the one that predicts best is used."""
NUM_ITERATIONS = 10
JUMP_PROBABILITY = 0.01
"""Prior probability that a photo's direction is independent of its neighbors'."""
MIN_PHOTOS = 4
"""Fewest photos whose order is used."""


def resolve_flips(hypotheses: Sequence[Sequence[Hypothesis]], points: Sequence[Float[np.ndarray, "_ 3"]]) -> list[int]:
    """Selects each photo's most probable pose, by its reprojection error and the neighboring photos.

    Args:
        hypotheses: at least one for each photo, best first; photos in the order taken.
        points: world points that each photo shows, meters.

    Returns:
        The selected index in each list.
    """
    if len(hypotheses) < MIN_PHOTOS:
        return [0] * len(hypotheses)
    # Each photo's pose takes six degrees of freedom; the remaining residuals are noise.
    degrees_of_freedom = sum(max(2 * len(visible_points) - 6, 1) for visible_points in points)
    variance = max(sum(options[0].sum_of_squares for options in hypotheses) / degrees_of_freedom, 1e-4)
    squares = [np.array([h.sum_of_squares for h in options]) for options in hypotheses]
    likelihoods = [np.exp((x[0] - x) / (2 * variance)) for x in squares]
    center = np.median([visible_points.mean(0) for visible_points in points], axis=0)
    offsets = [np.stack([invert_pose(h.pose)[:3, 3] - center for h in options]) for options in hypotheses]
    directions = [each / np.linalg.norm(each, axis=1, keepdims=True) for each in offsets]
    lag = np.subtract.outer(np.arange(len(points)), np.arange(len(points)))
    kernels = [np.exp(-((lag / width) ** 2) / 2) * (lag != 0) for width in NEIGHBOR_STD_PHOTOS]
    posteriors = [likelihood / likelihood.sum() for likelihood in likelihoods]
    for _ in range(NUM_ITERATIONS):
        means = np.stack([posterior @ each for posterior, each in zip(posteriors, directions, strict=True)])
        fits = []
        for kernel in kernels:
            predicted = kernel @ means / kernel.sum(1, keepdims=True)
            squares = [((each - mean) ** 2).sum(1) for each, mean in zip(directions, predicted, strict=True)]
            median = np.median([posterior @ each for posterior, each in zip(posteriors, squares, strict=True)])
            fits.append((median / (2 * np.log(2)), squares))  # of two Gaussian numbers' squares, by their median
        spread, squares = min(fits, key=lambda fit: fit[0])
        priors = [(1 - JUMP_PROBABILITY) * np.exp(-each / (2 * spread)) / spread + JUMP_PROBABILITY for each in squares]
        posteriors = [each * prior / (each @ prior) for each, prior in zip(likelihoods, priors, strict=True)]
    return [int(posterior.argmax()) for posterior in posteriors]
