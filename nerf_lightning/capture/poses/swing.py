"""Where around its tags a camera may have stood: how well each place explains the corners of one photo."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.geometry import move, normalised
from nerf_lightning.dataset.lens import Lens

WIDEST = np.radians(45.0)
"""Farthest swing away from the middle of a photo's solutions."""
CELLS = 25
"""Places along each side of the grid."""
ROUNDS = 3
"""Times that the grid closes in on the likely places; the last one is kept."""
STEPS = 2
"""Of Gauss-Newton, for what a swing leaves open."""
UNLIKELY = 12.0
"""Places whose logarithm of the likelihood is lower than the best one's by more are not looked at."""


@dataclass(frozen=True)
class Places:
    """A grid of places of one photo's camera."""

    centres: Float[np.ndarray, "S 3"]
    """In the world."""
    squares: Float[np.ndarray, "S"]
    """Least sum of squared reprojection distances from there, pixels^2."""


def places_around(
    lens: Lens, poses: Float[np.ndarray, "K 4 4"], points: np.ndarray, pixels: np.ndarray, variance: float
) -> Places:
    """Places that a camera may have had among a photo's solutions, evenly spread in angle.

    The camera swings around the middle of the points, about two axes across the line of sight; its distance, its aim and its
    roll follow from the pixels.

    Args:
        poses: world to camera; the solutions of the photo.
        points: in the world.
        variance: of a corner's coordinate, pixels^2.
    """
    middle = points.mean(0)
    there = move(poses[0], middle[None])[0]
    ray = there / np.linalg.norm(there)
    across = np.cross(ray, np.eye(3)[np.abs(ray).argmin()])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(ray, across)])
    # From the first solution to the others: a turn across the line of sight, without roll.
    swings = np.stack([_across(pose[:3, :3] @ poses[0, :3, :3].T, ray) @ axes.T for pose in poses])
    low, high = swings.min(0) - WIDEST / 2, swings.max(0) + WIDEST / 2
    tangents = normalised(lens, pixels)
    focal = np.array([lens.fx, lens.fy])
    for _ in range(ROUNDS):
        grid = np.stack(np.meshgrid(*np.linspace(low, high, CELLS).T), axis=-1).reshape(-1, 2)
        turns = _rotations(grid @ axes) @ poses[0, :3, :3]
        centres, squares = _followed(turns, there, points - middle, tangents, focal, ray)
        likely = grid[squares < squares.min() + 2 * UNLIKELY * variance]
        margin = (high - low) / (CELLS - 1)
        low, high = np.maximum(low, likely.min(0) - margin), np.minimum(high, likely.max(0) + margin)
    return Places(centres + middle, squares)


def _across(turn: Float[np.ndarray, "3 3"], ray: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The rotation vector of a turn, after its part about the ray is taken away."""
    moved = turn.T @ ray
    axis = np.cross(moved, ray)
    sine = float(np.linalg.norm(axis))
    return axis / max(sine, 1e-12) * float(np.arctan2(sine, moved @ ray))


def _rotations(vectors: Float[np.ndarray, "S 3"]) -> Float[np.ndarray, "S 3 3"]:
    """Matrices of rotation vectors (Rodrigues' formula)."""
    angle = np.linalg.norm(vectors, axis=1)[:, None, None]
    x, y, z = vectors.T
    o = np.zeros_like(x)
    cross = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=1).reshape(-1, 3, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * cross + np.sinc(angle / (2 * np.pi)) ** 2 / 2 * (cross @ cross)


def _followed(
    turns: Float[np.ndarray, "S 3 3"],
    there: Float[np.ndarray, "3"],
    arms: Float[np.ndarray, "M 3"],
    tangents: Float[np.ndarray, "M 2"],
    focal: Float[np.ndarray, "2"],
    ray: Float[np.ndarray, "3"],
) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S"]]:
    """The best distance, aim and roll for each turn, by Gauss-Newton.

    Args:
        turns: from the world to the camera.
        there: the middle of the points in the camera's frame, to start from.
        arms: from it to the points, in the world.
        tangents: x / z and y / z of the points as seen.
        ray: unit vector to the middle.

    Returns:
        Camera centres, from the middle of the points in the world; sums of squares, pixels^2.
    """
    shifts = np.tile(there, (len(turns), 1))
    for step in range(STEPS + 1):
        turned = arms @ turns.swapaxes(1, 2)
        x, y, z = np.moveaxis(turned + shifts[:, None], -1, 0)
        rest = (np.stack([x / z, y / z], axis=-1) - tangents) * focal
        if step == STEPS:
            break
        o = np.zeros_like(z)
        across, down = np.stack([1 / z, o, -x / z**2], axis=-1), np.stack([o, 1 / z, -y / z**2], axis=-1)
        by_shift = np.stack([across, down], axis=-2) * focal[:, None]
        by_roll = by_shift @ np.cross(ray, turned)[..., None]
        J = np.concatenate([by_shift, by_roll], axis=-1).reshape(len(turns), -1, 4)
        back = J.swapaxes(1, 2)
        change = -np.linalg.solve(back @ J, back @ rest.reshape(len(turns), -1, 1))[..., 0]
        shifts = shifts + change[:, :3]
        turns = _rotations(change[:, 3:] * ray) @ turns
    return -np.einsum("sji,sj->si", turns, shifts), (rest**2).sum((1, 2))
