"""The photographer's walk: neighbouring photos show which of the two poses of a flat tag is right."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import inverse, to_vector
from nerf_lightning.capture.poses.pose import Hypothesis
from nerf_lightning.capture.poses.smooth import KINDS, Walk, Windows
from nerf_lightning.capture.poses.swing import UNLIKELY, places_around
from nerf_lightning.dataset.lens import Lens

Seen = Sequence[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 2"]]]
"""Points in the world and their pixels, by photo."""
BLUR = 0.01
"""Standard deviation by which each place is blurred, radians: what is known more exactly needs no neighbours."""
SWEEPS, DAMPING = 24, 0.6
"""Of expectation propagation: passes over all photos, and the share of the new in each."""
FIRST_REACH = 6.0
"""Of the search for the likeliest walk, photos."""
WEAKEST = 1e-4
"""Least precision of what a photo says, radians^-2."""


def choose(lens: Lens, hypotheses: Sequence[Sequence[Hypothesis]], seen: Seen) -> list[int]:
    """Chooses a hypothesis for each photo: the one nearest to where the camera stood, by all photos together.

    A flat tag seen nearly from the front has two poses of about the same reprojection error, and noise decides between them.
    But photos are taken one after the other, and the wrong poses do not make a smooth walk. How smooth the walk is, how far it
    strays and how exact corners are is learned from the same photos, so that photos in no order say nothing of each other.

    Args:
        lens: of all photos.
        hypotheses: at least one for each photo, best first; photos in the order taken.
        seen: the points in the world and their pixels, by photo.

    Returns:
        The index chosen in each list.
    """
    first = [0] * len(hypotheses)
    if len(hypotheses) < 4 or all(len(options) == 1 for options in hypotheses):
        return first
    # Six numbers were fitted to each photo: the remaining residuals are the noise.
    spare = sum(max(2 * len(points) - 6, 1) for points, _ in seen)
    variance = max(sum(options[0].squares for options in hypotheses) / spare, 1e-4)
    viable = [[h for h in o if h.squares <= o[0].squares + 2 * UNLIKELY * variance] for o in hypotheses]
    if all(len(options) == 1 for options in viable):
        return first
    views = Views.of(lens, viable, seen, variance)
    fits = [propagated(views, kind, variance) for kind in KINDS]
    middle, _ = max(fits, key=lambda fit: fit[1])

    def off(hypothesis: Hypothesis, photo: int) -> float:
        return float(np.linalg.norm(views.charted(inverse(hypothesis.pose)[:3, 3]) - middle[photo]))

    return [min(range(len(options)), key=lambda i: off(options[i], n)) for n, options in enumerate(viable)]


@dataclass(frozen=True)
class Views:
    """From where each photo may have been taken, as directions from the middle of the tags."""

    origin: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    """Rows: the last one is the pole of the chart."""
    places: Float[np.ndarray, "N S 2"]
    """Of each photo, on the chart."""
    squares: Float[np.ndarray, "N S"]
    """Sums of squared reprojection distances from there, pixels^2."""
    spare: Float[np.ndarray, "N"]
    """Coordinates of corners less the numbers fitted to them at each place."""

    @classmethod
    def of(cls, lens: Lens, options: Sequence[Sequence[Hypothesis]], seen: Seen, variance: float) -> "Views":
        origin = np.median([points.mean(0) for points, _ in seen], axis=0)
        directions = np.stack([inverse(found[0].pose)[:3, 3] - origin for found in options])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        pole = np.linalg.svd(directions.mean(0)[None])[2]
        axes = np.roll(pole if float(pole[0] @ directions.sum(0)) > 0 else -pole, -1, axis=0)
        chart = cls(origin, axes, np.empty((0, 0, 2)), np.empty((0, 0)), np.empty(0))
        all_places, all_squares = [], []
        for found, (points, pixels) in zip(options, seen, strict=True):
            if len(found) == 1 and _spread(lens, found[0], points, pixels, variance) < BLUR:
                centres, squares = inverse(found[0].pose)[None, :3, 3], np.array([found[0].squares])
            else:
                around = places_around(lens, np.stack([h.pose for h in found]), points, pixels, variance)
                centres, squares = around.centres, around.squares
            all_places.append(chart.charted(centres))
            all_squares.append(squares)
        most = max(map(len, all_places))
        # A photo that is sure of its place has it many times.
        grid = np.stack([np.resize(places, (most, 2)) for places in all_places])
        squares = np.stack([np.resize(squares, most) for squares in all_squares])
        return cls(origin, axes, grid, squares, np.array([2.0 * len(points) - 4 for points, _ in seen]))

    def charted(self, centres: Float[np.ndarray, "*s 3"]) -> Float[np.ndarray, "*s 2"]:
        """Directions to camera centres on a plane: the stereographic projection, true to scale at its pole, radians."""
        local = (centres - self.origin) @ self.axes.T
        local /= np.linalg.norm(local, axis=-1, keepdims=True)
        return 2 * local[..., :2] / (1 + local[..., 2:]).clip(1e-3)


def _spread(lens: Lens, hypothesis: Hypothesis, points: np.ndarray, pixels: np.ndarray, variance: float) -> float:
    """Standard deviation of the direction to a camera in which it is least known, radians."""
    vector = to_vector(hypothesis.pose)
    _, jacobian = cv2.projectPoints(points[:, None], vector[:3], vector[3:], lens.K, np.array(lens.distortion))
    J = jacobian[:, :6]
    turns = np.linalg.inv(J.T @ J + 1e-9 * np.eye(6))[:3, :3] * variance
    return float(np.sqrt(np.linalg.eigvalsh(turns)[-1]))


def propagated(views: Views, kind: float, variance: float) -> tuple[Float[np.ndarray, "N 2"], float]:
    """Where each photo was taken, by the likeliest walk of one kind: expectation propagation (Minka 2001).

    What each photo says is replaced by a Gaussian that acts alike beside what all the others say. In between, the walk and the
    variance of the corners move to more evidence.

    Args:
        kind: see `Walk`.
        variance: of a corner's coordinate, to start from, pixels^2.

    Returns:
        The means, on the chart; and the logarithm of the evidence, up to what all kinds share.
    """
    count = len(views.places)
    best = views.places[np.arange(count), views.squares.argmin(1)]
    places = views.places - best.mean(0)
    windows, walk = Windows.of(count), Walk(float(best.std()), FIRST_REACH, kind)
    mean, covariance, _ = _moments(places, -views.squares / (2 * variance))
    precision = np.linalg.inv(covariance)
    pull = np.einsum("nij,nj->ni", precision, mean)
    for sweep in range(SWEEPS):
        # The walk first in large steps, then in small ones, then no more.
        if sweep % 2 == 0 and sweep < SWEEPS - 6:
            factor = 2**0.5 if sweep < SWEEPS // 2 else 2**0.25
            walk = max(walk.near(factor), key=lambda changed: windows.evidence(changed, precision, pull))
        middle, spread = windows.marginals(walk, precision, pull)
        inverted = np.linalg.inv(spread)
        others = _positive(inverted - precision, WEAKEST)
        others_pull = np.einsum("nij,nj->ni", inverted, middle) - pull
        centre = np.linalg.solve(others, others_pull[..., None])[..., 0]
        away = places - centre[:, None]
        logs = -views.squares / (2 * variance) - np.einsum("nsi,nij,nsj->ns", away, others, away) / 2
        mean, covariance, weights = _moments(places, logs)
        if sweep == SWEEPS - 1:
            break
        variance = (variance + max(float((weights * views.squares).sum() / views.spare.sum()), 1e-4)) / 2
        fitted = _positive(np.linalg.inv(covariance) - others, WEAKEST)
        fitted_pull = np.einsum("nij,nj->ni", fitted + others, mean) - others_pull
        precision = (1 - DAMPING) * precision + DAMPING * fitted
        pull = (1 - DAMPING) * pull + DAMPING * fitted_pull
    top = logs.max(1)
    said = top + np.log(np.exp(logs - top[:, None]).sum(1)) + np.linalg.slogdet(others + precision)[1] / 2
    said += _peak(others, others_pull) - _peak(others + precision, others_pull + pull)
    whole = windows.evidence(walk, precision, pull, each=True)
    return mean + best.mean(0), float(said.sum() - views.spare.sum() / 2 * np.log(variance)) + whole


def _moments(
    places: Float[np.ndarray, "N S 2"], logs: Float[np.ndarray, "N S"]
) -> tuple[Float[np.ndarray, "N 2"], Float[np.ndarray, "N 2 2"], Float[np.ndarray, "N S"]]:
    """Mean and covariance of weighted places, and the weights, whose logarithms are given up to a constant a photo."""
    weights = np.exp(logs - logs.max(1, keepdims=True))
    weights /= weights.sum(1, keepdims=True)
    mean = np.einsum("ns,nsi->ni", weights, places)
    away = places - mean[:, None]
    return mean, np.einsum("ns,nsi,nsj->nij", weights, away, away) + BLUR**2 * np.eye(2), weights


def _positive(matrices: Float[np.ndarray, "N 2 2"], least: float) -> Float[np.ndarray, "N 2 2"]:
    """Symmetric matrices with their eigenvalues raised to at least this."""
    values, vectors = np.linalg.eigh(matrices)
    return (vectors * values.clip(least)[:, None]) @ vectors.swapaxes(1, 2)


def _peak(precision: Float[np.ndarray, "N 2 2"], pull: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N"]:
    """The largest value of -x P x / 2 + p x."""
    return np.einsum("ni,ni->n", pull, np.linalg.solve(precision, pull[..., None])[..., 0]) / 2
