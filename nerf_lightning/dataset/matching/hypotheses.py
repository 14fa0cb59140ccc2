"""Hypotheses for wrong poses: common mistakes with conventions and order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from nerf_lightning.dataset.formats.file_names import make_natural_key

Rotations = Float[np.ndarray, "V 3 3"]
Poses = Float[np.ndarray, "V 4 4"]

OPENGL_FLIP = np.diag([1.0, -1.0, -1.0])
"""Converts camera axes between OpenGL and OpenCV."""


@dataclass(frozen=True)
class Hypothesis:
    """Possible intended cameras of a file, and the fault in the file if they are right."""

    fault: str
    hint: str
    c2w: Poses
    """OpenCV; any world frame, since only relative poses matter. Mirrored cameras have det R = -1."""
    zoom: float = 1.0
    """Focal length, relative to the file's."""
    is_rare: bool = False
    """Whether the mistake is rare: it must explain clearly more matches than the others."""


def list_conventions(c2w: Poses) -> Iterator[Hypothesis]:
    """Lists poses under other conventions, most likely first.

    Args:
        c2w: as read, OpenCV, in the file's world frame.
    """
    rotation, center = c2w[:, :3, :3], c2w[:, :3, 3:]
    transposed = rotation.transpose(0, 2, 1)
    inverse_center = -transposed @ center
    flips, changes = (np.eye(3), OPENGL_FLIP), list_axis_changes()[1:]

    def make_hypothesis(
        fault: str, hint: str, rotation: Rotations, center: Float[np.ndarray, "V 3 1"], is_rare: bool = False
    ) -> Hypothesis:
        poses = c2w.copy()
        poses[:, :3] = np.concatenate([rotation, center], axis=2)
        return Hypothesis(fault, hint, poses, is_rare=is_rare)

    axes = "camera axes of the other convention: OpenCV has y down and z forward, OpenGL y up and z backward"
    yield make_hypothesis(axes, "negate the second and third column of each rotation", rotation @ OPENGL_FLIP, center)
    inverse = "world-to-camera matrices instead of camera-to-world"
    for flip in flips:
        yield make_hypothesis(inverse, "invert each matrix", transposed @ flip, inverse_center)
    for left, right in product(flips, repeat=2):
        fault = "transposed rotations with camera centers"
        yield make_hypothesis(fault, "transpose each rotation", left @ transposed @ right, center)
    for flip in flips:
        fault = "camera-to-world rotations with world-to-camera translations"
        hint = "put the camera centers -R t in the fourth column"
        yield make_hypothesis(fault, hint, rotation, -rotation @ flip @ center)
    for change in changes:
        if np.linalg.det(change) < 0:
            fault = "a mirrored world: left-handed axes, or photos that are flipped"
            hint = "negate one axis, of the world and of the cameras, or flip the photos back"
        elif change[2, 2] == 1:
            fault = "photos that are rotated by 90 or 180 degrees relative to their cameras"
            hint = "rotate them; dataset.orientation=exif does so by their EXIF data"
        else:
            fault, hint = "permuted camera axes", "the columns of a rotation are the camera's axes in the world"
        yield make_hypothesis(fault, hint, rotation @ change, center, is_rare=bool(change[2, 2] != 1))
        fault = f"{inverse}, with permuted axes"
        yield make_hypothesis(fault, "invert each matrix", transposed @ change, inverse_center, is_rare=True)
    fault, hint = "quaternions in another order", "the order is w, x, y, z"
    for backward in (False, True):
        for flip in flips:
            yield make_hypothesis(fault, hint, roll_quaternions(rotation @ flip, backward) @ flip, center)
        rolled = roll_quaternions(transposed, backward).transpose(0, 2, 1)
        # World-to-camera poses keep their translations.
        yield make_hypothesis(fault, hint, rolled, -rolled @ inverse_center)
    for flip, change in product(flips, changes):
        fault, hint = "centers and rotations in different world frames", "rotate both to one frame"
        yield make_hypothesis(fault, hint, rotation @ flip, change @ center, is_rare=True)


def list_axis_changes() -> list[Float[np.ndarray, "3 3"]]:
    """Lists the 48 signed axis permutations: the identity, the other rotations, then mirrors."""
    changes = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return sorted(changes, key=lambda change: (np.linalg.det(change) < 0, -np.trace(change)))


def roll_quaternions(rotation: Rotations, backward: bool) -> Rotations:
    """Reorders the quaternions of rotations, as if x, y, z, w had been read as w, x, y, z, or backward."""
    stored = Rotation.from_matrix(rotation).as_quat()  # x, y, z, w
    return Rotation.from_quat(np.roll(stored, 2 * backward - 1, axis=1)).as_matrix()


def list_orders(names: Sequence[str], c2w: Poses, indices: Int[np.ndarray, "K"]) -> Iterator[Hypothesis]:
    """Lists poses in another order than the photos.

    Args:
        names: names of the first photos, whose poses may be reordered.
        c2w: poses of all photos.
        indices: photos in the hypotheses.
    """
    alphabetical = np.array(sorted(range(len(names)), key=lambda i: names[i]))
    numeric = np.array(sorted(range(len(names)), key=lambda i: make_natural_key(names[i])))

    def make_hypothesis(fault: str, source: Int[np.ndarray, "V"], target: Int[np.ndarray, "V"]) -> Hypothesis:
        poses = c2w.copy()
        poses[target] = c2w[source]
        return Hypothesis(fault, "assign each photo its own pose", poses[indices])

    for order in (alphabetical, numeric):
        for step, neighbor in ((1, "previous"), (-1, "next")):
            # As read, each photo has the pose of the previous one; so its own is at the next.
            fault = f"poses shifted by one: each photo has that of the {neighbor} one by name"
            yield make_hypothesis(fault, np.roll(order, -step), order)
        yield make_hypothesis("poses in the reverse order of the photos", order[::-1], order)
    fault = "poses in another order than the photos: names sorted as numbers (2, 10) versus text (10, 2)"
    if (alphabetical != numeric).any():
        yield make_hypothesis(fault, alphabetical, numeric)
        yield make_hypothesis(fault, numeric, alphabetical)
