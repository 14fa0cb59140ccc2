"""Which of a flat tag's two poses is right: a hidden Markov model of the viewing direction over photos in the order taken.

A flat tag seen nearly from the front has two poses of about the same reprojection error, and noise decides between them. But
photos are taken one after the other, and the directions they look from change little between neighbours. The states are cells
of a grid of viewing directions, the observations the reprojection errors from there, and a transition is a Gaussian blur of the
grid, whose width is that of most evidence: photos in no order would need a wide one, and keep their best pose each.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, gaussian_filter1d, shift

from nerf_lightning.capture.poses.geometry import inverse, move, normalised
from nerf_lightning.capture.poses.pose import Hypothesis
from nerf_lightning.dataset.intrinsics import Intrinsics

Observation = tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 2"]]
"""Points in the world, metres, and their pixels in one photo."""
CELL_RAD = np.radians(2.0)
"""Side of a cell of the grid."""
MAX_RADIUS_RAD = 2.4
"""Largest half side of the grid: 100 degrees from its middle on the sphere."""
MARGIN_RAD = np.radians(10.0)
"""Around the directions of all hypotheses."""
STEPS_RAD = np.radians([1.0, 1.5, 2.0, 3.0, 4.5, 7.0])
"""Standard deviations of the change of direction between photos, by axis, among which the evidence chooses. The last one, and
whatever is wider, means that the photos are in no order."""
SMOOTHING_PHOTOS = 1.0
"""Standard deviation of the average over photos from which the drift is taken."""
JUMP_PROBABILITY = 0.01
"""That a photo was taken from anywhere, wherever the one before."""
MAX_LOG_RATIO = 12.0
"""Hypotheses less likely than the best by more, on their own, are impossible."""
MIN_PHOTOS = 4
"""Below which there is nothing to learn from their order."""


def resolve_flips(
    lens: Intrinsics, hypotheses: Sequence[Sequence[Hypothesis]], observations: Sequence[Observation]
) -> list[int]:
    """Chooses a pose for each photo: the one nearest to its posterior mean direction given all photos.

    Args:
        lens: of all photos.
        hypotheses: at least one for each photo, best first; photos in the order taken.
        observations: by photo.

    Returns:
        The index chosen in each list.
    """
    # Six numbers were fitted to each photo: the remaining residuals are the noise.
    spare = sum(max(2 * len(points) - 6, 1) for points, _ in observations)
    variance = max(sum(options[0].squares for options in hypotheses) / spare, 1e-4)
    possible = [[h for h in o if h.squares <= o[0].squares + 2 * MAX_LOG_RATIO * variance] for o in hypotheses]
    if len(hypotheses) < MIN_PHOTOS or all(len(options) == 1 for options in possible):
        return [0] * len(hypotheses)
    origin = np.median([points.mean(0) for points, _ in observations], axis=0)
    offsets = [np.stack([inverse(h.pose)[:3, 3] - origin for h in options]) for options in possible]
    chart = Chart.around(offsets)
    places = [chart.project(o) for o in offsets]
    directions, across = chart.frames()
    likelihoods = []
    for options, place, (points, pixels) in zip(possible, places, observations, strict=True):
        squares = _squared_errors(directions, across, lens, options[0].pose, points, pixels)
        # The middle of a cell may be farther from a sharp minimum than the noise allows.
        np.minimum.at(squares, chart.cells(place), [h.squares for h in options])
        likelihoods.append(np.exp((squares.min() - squares) / (2 * variance)).reshape(chart.side, chart.side))
    means, _ = _posterior_means(likelihoods, chart.axis, np.zeros((len(likelihoods) - 1, 2)))
    # Photographers keep moving the way they move: from the first means it shows which way.
    drift = np.diff(gaussian_filter1d(means, SMOOTHING_PHOTOS, axis=0), axis=0)
    means, step = _posterior_means(likelihoods, chart.axis, drift)
    if step == STEPS_RAD[-1]:
        return [0] * len(hypotheses)
    return [int(np.linalg.norm(p - mean, axis=1).argmin()) for p, mean in zip(places, means, strict=True)]


@dataclass(frozen=True)
class Chart:
    """A square grid of viewing directions on a plane: the stereographic projection, true to scale at its pole."""

    axes: Float[np.ndarray, "3 3"]
    """Rows: the last one is the pole, in the world."""
    side: int
    """Cells, an odd number."""

    @classmethod
    def around(cls, offsets: Sequence[Float[np.ndarray, "_ 3"]]) -> "Chart":
        """A grid that holds the directions of all offsets, which are given by photo, best first."""
        first = np.stack([o[0] / np.linalg.norm(o[0]) for o in offsets]).sum(0)
        axes = np.linalg.svd(first[None])[2]
        chart = cls(np.roll(axes if axes[0] @ first > 0 else -axes, -1, axis=0), 1)
        radius = min(float(np.abs(chart.project(np.concatenate(offsets))).max()) + MARGIN_RAD, MAX_RADIUS_RAD)
        return cls(chart.axes, 2 * int(np.ceil(radius / CELL_RAD)) + 1)

    @property
    def axis(self) -> Float[np.ndarray, "S"]:
        """Middles of the cells along one side, radians."""
        return (np.arange(self.side) - self.side // 2) * CELL_RAD

    def frames(self) -> tuple[Float[np.ndarray, "C 3"], Float[np.ndarray, "C 3"]]:
        """The direction of each cell, and one across it; unit vectors in the world."""
        x, y = (c.reshape(-1) for c in np.meshgrid(self.axis, self.axis, indexing="ij"))
        q = (x**2 + y**2) / 4
        directions, across = np.stack([x, y, 1 - q], axis=1), np.stack([1 + q - x**2 / 2, -x * y / 2, -x], axis=1)
        return directions / (1 + q[:, None]) @ self.axes, across / (1 + q[:, None]) @ self.axes

    def project(self, offsets: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Directions of world vectors on the plane, radians."""
        local = offsets @ self.axes.T / np.linalg.norm(offsets, axis=1, keepdims=True)
        return 2 * local[:, :2] / (1 + local[:, 2:]).clip(1e-3)

    def cells(self, places: Float[np.ndarray, "N 2"]) -> np.ndarray:
        """Numbers of the cells of places on the plane."""
        x, y = (np.rint(places / CELL_RAD).astype(int) + self.side // 2).clip(0, self.side - 1).T
        return x * self.side + y


def _squared_errors(
    directions: Float[np.ndarray, "C 3"],
    across: Float[np.ndarray, "C 3"],
    lens: Intrinsics,
    w2c: Float[np.ndarray, "4 4"],
    points: Float[np.ndarray, "M 3"],
    pixels: Float[np.ndarray, "M 2"],
) -> Float[np.ndarray, "C"]:
    """Least sum of squared reprojection errors, pixels^2, of a camera that sees points from a direction.

    The camera is turned to the points' middle and kept at its distance. Then roll, zoom and shift, which are free, are a linear
    fit of complex numbers: seen = a * projected + b.

    Args:
        directions, across: unit vectors from the points' middle toward the camera, and at right angles to that.
        w2c: a pose of about the right distance.
    """
    middle = move(w2c, points.mean(0)[None])[0]
    distance = float(np.linalg.norm(middle))
    ahead = middle / distance
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    rays = np.pad(normalised(lens, pixels), ((0, 0), (0, 1)), constant_values=1.0)
    seen = rays @ (right + 1j * np.cross(ahead, right)) / (rays @ ahead)
    seen -= seen.mean()
    arms = points - points.mean(0)
    projected = (across + 1j * np.cross(across, directions)) @ arms.T / (distance - directions @ arms.T)
    projected -= projected.mean(1, keepdims=True)
    explained = np.abs(projected.conj() @ seen) ** 2 / (np.abs(projected) ** 2).sum(1)
    return (np.vdot(seen, seen).real - explained) * lens.fx * lens.fy


def _posterior_means(
    likelihoods: Sequence[Float[np.ndarray, "S S"]], axis: Float[np.ndarray, "S"], drift: Float[np.ndarray, "M 2"]
) -> tuple[Float[np.ndarray, "N 2"], float]:
    """Mean direction of each photo given all photos, with the step width of most evidence, and that width (the
    forward-backward algorithm; Rabiner 1989).

    Args:
        likelihoods: of each cell, by photo.
        axis: middles of the cells along one side.
        drift: expected change of direction from each photo to the next, radians.
    """

    def predict(belief: Float[np.ndarray, "S S"], step: float, by: Float[np.ndarray, "2"]) -> Float[np.ndarray, "S S"]:
        moved = shift(belief, by / CELL_RAD, order=1, mode="nearest") if by.any() else belief
        return (1 - JUMP_PROBABILITY) * gaussian_filter(moved, step / CELL_RAD) + JUMP_PROBABILITY * belief.mean()

    fits = []
    for step in STEPS_RAD:
        forward, evidence = [likelihoods[0] / likelihoods[0].sum()], 0.0
        for likelihood, by in zip(likelihoods[1:], drift, strict=True):
            joint = predict(forward[-1], step, by) * likelihood
            evidence += float(np.log(joint.sum()))
            forward.append(joint / joint.sum())
        fits.append((evidence, step, forward))
    _, step, forward = max(fits, key=lambda fit: fit[0])
    backward, means = np.ones_like(likelihoods[0]), np.empty((len(likelihoods), 2))
    for i in reversed(range(len(likelihoods))):
        joint = forward[i] * backward
        means[i] = np.array([axis @ joint.sum(1), axis @ joint.sum(0)]) / joint.sum()
        if i:
            backward = predict(backward * likelihoods[i], step, -drift[i - 1])
            backward /= backward.sum()
    return means, float(step)
