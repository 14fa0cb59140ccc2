"""The photographer's walk: neighbouring photos show which of the two poses of a flat tag is right."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from scipy.sparse import block_diag, csr_matrix, diags, identity, kron
from scipy.sparse.linalg import splu, spsolve

from nerf_lightning.capture.poses.geometry import angle_between, inverse, to_vector
from nerf_lightning.capture.poses.pose import Hypothesis
from nerf_lightning.dataset.lens import Lens

STIFFNESS = np.radians([0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 6.4])
"""Typical bends to try: by how much a step from photo to photo differs from the one before, in radians and in shares of the
distance to the tags. The bend of the largest evidence is taken."""
WALK_ERROR = np.radians(4.0)
"""Standard deviation of the poses of a smoothed walk: about half the angle between solutions that matter."""
ROUNDS = 16
"""Iterations of Gauss-Newton; in the first half all bends have the same weight, which pulls flipped first guesses along."""
TAIL = 4.0
"""Degrees of freedom of Student's t, the distribution of bends: jumps are rare but possible."""


def choose(
    lens: Lens,
    hypotheses: Sequence[Sequence[Hypothesis]],
    seen: Sequence[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 2"]]],
) -> list[int]:
    """Chooses a hypothesis for each photo, by its error and its distance from the likeliest smooth walk through all photos.

    A flat tag seen nearly from the front has two poses of about the same reprojection error, and noise decides between them.
    But photos are taken one after the other, and the wrong poses do not make a smooth walk. If photos are far apart, every
    walk bends at every step, and the reprojection error decides again.

    Args:
        lens: of all photos.
        hypotheses: at least one for each photo, best first; photos in the order taken.
        seen: the points in the world and their pixels, by photo.

    Returns:
        The index chosen in each list.
    """
    if len(hypotheses) < 4 or all(len(options) == 1 for options in hypotheses):
        return [0] * len(hypotheses)
    # Six numbers were fitted to each photo: the remaining residuals are the noise.
    spare = sum(max(2 * len(points) - 6, 1) for points, _ in seen)
    variance = max(sum(options[0].squares for options in hypotheses) / spare, 1e-4)
    start = [inverse(options[0].pose) for options in hypotheses]
    walks = [smoothed(lens, start, seen, variance, float(bend)) for bend in STIFFNESS]
    walk, _ = max(walks, key=lambda found: found[1])

    def cost(hypothesis: Hypothesis, pose: Float[np.ndarray, "4 4"]) -> float:
        off = angle_between(inverse(hypothesis.pose), pose) / WALK_ERROR
        return hypothesis.squares / (2 * variance) + off**2 / 2

    return [
        min(range(len(options)), key=lambda i: cost(options[i], pose))
        for options, pose in zip(hypotheses, walk, strict=True)
    ]


def smoothed(
    lens: Lens,
    start: Sequence[Float[np.ndarray, "4 4"]],
    seen: Sequence[tuple[Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 2"]]],
    variance: float,
    bend: float,
) -> tuple[list[Float[np.ndarray, "4 4"]], float]:
    """The walk with the best balance of reprojection errors and bends, by iteratively reweighted least squares.

    The unknowns are a small rotation and translation of each pose, in the world's frame. Bends follow Student's t: a jump
    between two rounds of photos costs little.

    Args:
        start: camera to world, by photo.
        variance: of a corner's coordinate, pixels^2.
        bend: typical change from one step to the next, radians (and shares of the distance).

    Returns:
        The poses, and the logarithm of the evidence for such a bend (Laplace's approximation, up to a constant).
    """
    count = len(start)
    poses = [pose.copy() for pose in start]
    scale = float(np.median([np.linalg.norm(inverse(pose)[:3, 3]) for pose in start]))
    unit = np.tile([1, 1, 1, scale, scale, scale], count)  # lengths in units of the distance
    second = diags([1.0, -2.0, 1.0], [0, 1, 2], shape=(count - 2, count))
    D = csr_matrix(kron(second, identity(6)))
    for round_ in range(ROUNDS):
        blocks, slopes = zip(*(_pull(lens, p, *s) for p, s in zip(poses, seen, strict=True)), strict=True)
        bends = _bends(poses, scale)
        square = (bends**2).sum(1) / bend**2
        heavy = (TAIL + 6) / (TAIL + square) if round_ >= ROUNDS // 2 else np.ones(len(bends))
        weight = heavy / bend**2
        W = diags(np.repeat(weight, 6))
        H = diags(unit) @ (block_diag(blocks) / variance) @ diags(unit) + D.T @ W @ D + 1e-9 * diags(np.ones(6 * count))
        g = unit * (np.concatenate(slopes) / variance) + D.T @ (W @ bends.reshape(-1))
        step = (-spsolve(H.tocsc(), g) * unit).reshape(count, 6)
        longest = float(np.abs(step[:, :3]).max())
        step *= min(1.0, 0.3 / max(longest, 1e-12))
        for pose, change in zip(poses, step, strict=True):
            pose[:3, :3] = cv2.Rodrigues(change[:3])[0] @ pose[:3, :3]
            pose[:3, 3] += change[3:]
    squares = sum(float((_residual(lens, p, *s)[0] ** 2).sum()) for p, s in zip(poses, seen, strict=True))
    square = (_bends(poses, scale) ** 2).sum(1) / bend**2
    prior = ((TAIL + 6) / 2 * np.log1p(square / TAIL) + 6 * np.log(bend)).sum()
    log_determinant = np.log(np.abs(splu(H.tocsc()).U.diagonal())).sum()
    return poses, float(-squares / (2 * variance) - prior - log_determinant / 2)


def _bends(poses: Sequence[np.ndarray], scale: float) -> Float[np.ndarray, "B 6"]:
    """How each step from photo to photo differs from the one before: rotation vectors, and shifts over the distance."""
    turns = [cv2.Rodrigues(b[:3, :3] @ a[:3, :3].T)[0].reshape(3) for a, b in zip(poses, poses[1:], strict=False)]
    centres = np.stack([pose[:3, 3] for pose in poses]) / scale
    return np.concatenate([np.diff(np.stack(turns), axis=0), np.diff(centres, 2, axis=0)], axis=1)


def _residual(
    lens: Lens, pose: np.ndarray, points: np.ndarray, pixels: np.ndarray
) -> tuple[Float[np.ndarray, "twoM"], Float[np.ndarray, "twoM 3"]]:
    """Projected minus seen, and the derivative with respect to a shift of the points in the camera's frame."""
    vector = to_vector(inverse(pose))
    projected, jacobian = cv2.projectPoints(points[:, None], vector[:3], vector[3:], lens.K, np.array(lens.distortion))
    return (projected.reshape(-1, 2) - pixels).reshape(-1), jacobian[:, 3:6]


def _pull(
    lens: Lens, pose: np.ndarray, points: np.ndarray, pixels: np.ndarray
) -> tuple[Float[np.ndarray, "6 6"], Float[np.ndarray, "6"]]:
    """J^T J and J^T r of one photo, for a rotation and a translation of its pose in the world's frame."""
    residual, by_camera = _residual(lens, pose, points, pixels)
    by_world = (by_camera @ pose[:3, :3].T).reshape(-1, 2, 3)
    # Turning the camera by w moves a point, as the camera sees it, by -w x (p - c); shifting the camera by s, by -s.
    arms = points - pose[:3, 3]
    J = np.concatenate([np.cross(by_world, arms[:, None]), -by_world], axis=2).reshape(-1, 6)
    return J.T @ J, J.T @ residual
