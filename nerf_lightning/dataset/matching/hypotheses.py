"""Mistakes that people make with the cameras of a file."""

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
"""Camera axes of OpenGL in OpenCV's, and the reverse."""


@dataclass(frozen=True)
class Hypothesis:
    """Cameras that a file may mean, and what is wrong with it if it does."""

    fault: str
    hint: str
    c2w: Poses
    """OpenCV; in no particular world frame, as only relative poses count. Mirrored cameras have det R = -1."""
    zoom: float = 1.0
    """Focal length, in those given."""
    is_rare: bool = False
    """Whether hardly anybody errs so: it must explain clearly more than the others."""


def list_conventions(c2w: Poses) -> Iterator[Hypothesis]:
    """What other tools' conventions make of poses; the likeliest first.

    Args:
        c2w: as read, OpenCV, in the file's world frame.
    """
    rotation, centre = c2w[:, :3, :3], c2w[:, :3, 3:]
    transposed = rotation.transpose(0, 2, 1)
    of_inverse = -transposed @ centre
    flips, changes = (np.eye(3), OPENGL_FLIP), list_axis_changes()[1:]

    def suppose(
        fault: str, hint: str, rotation: Rotations, centre: Float[np.ndarray, "V 3 1"], is_rare: bool = False
    ) -> Hypothesis:
        moved = c2w.copy()
        moved[:, :3] = np.concatenate([rotation, centre], axis=2)
        return Hypothesis(fault, hint, moved, is_rare=is_rare)

    axes = "camera axes of the other convention: OpenCV has y down and z forward, OpenGL y up and z backward"
    yield suppose(axes, "negate the second and third column of each rotation", rotation @ OPENGL_FLIP, centre)
    inverse = "world-to-camera matrices, where camera-to-world ones belong"
    for flip in flips:
        yield suppose(inverse, "invert each matrix", transposed @ flip, of_inverse)
    for left, right in product(flips, repeat=2):
        fault = "transposed rotations beside the cameras' centres"
        yield suppose(fault, "transpose each rotation", left @ transposed @ right, centre)
    for flip in flips:
        fault = "camera-to-world rotations beside translations of world-to-camera matrices"
        hint = "put the cameras' centres -R t in the fourth column"
        yield suppose(fault, hint, rotation, -rotation @ flip @ centre)
    for change in changes:
        if np.linalg.det(change) < 0:
            fault = "a mirrored world: left-handed axes, or photos that are flipped"
            hint = "negate one axis, of the world and of the cameras, or flip the photos back"
        elif change[2, 2] == 1:
            fault = "photos that lie on their sides or upside down in their cameras"
            hint = "turn them, as dataset.orientation=exif does where their EXIF data say so"
        else:
            fault, hint = "camera axes in another order", "the columns of a rotation are the camera's axes in the world"
        yield suppose(fault, hint, rotation @ change, centre, is_rare=bool(change[2, 2] != 1))
        yield suppose(f"{inverse}, of other axes", "invert each matrix", transposed @ change, of_inverse, is_rare=True)
    fault, hint = "rotations of quaternions in another order", "the order is w, x, y, z"
    for backward in (False, True):
        for flip in flips:
            yield suppose(fault, hint, roll_quaternions(rotation @ flip, backward) @ flip, centre)
        turned = roll_quaternions(transposed, backward).transpose(0, 2, 1)
        yield suppose(fault, hint, turned, -turned @ of_inverse)  # world-to-camera poses keep their translations
    for flip, change in product(flips, changes):
        fault, hint = "centres in another world frame than rotations", "turn both alike"
        yield suppose(fault, hint, rotation @ flip, change @ centre, is_rare=True)


def list_axis_changes() -> list[Float[np.ndarray, "3 3"]]:
    """The 48 ways to name three axes: the identity, the other rotations, then mirrors."""
    every = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return sorted(every, key=lambda one: (np.linalg.det(one) < 0, -np.trace(one)))


def roll_quaternions(rotation: Rotations, backward: bool) -> Rotations:
    """Rotations of the same quaternions, had x, y, z, w been read as w, x, y, z, or in reverse."""
    stored = Rotation.from_matrix(rotation).as_quat()  # x, y, z, w
    return Rotation.from_quat(np.roll(stored, 2 * backward - 1, axis=1)).as_matrix()


def list_orders(names: Sequence[str], c2w: Poses, indices: Int[np.ndarray, "K"]) -> Iterator[Hypothesis]:
    """Poses in another order than the photos.

    Args:
        names: of the first photos, which may be in another order.
        c2w: of all photos.
        kept: those whose poses count.
    """
    every = range(len(names))
    alphabetical = np.array(sorted(every, key=lambda i: names[i]))
    numeric = np.array(sorted(every, key=lambda i: make_natural_key(names[i])))

    def suppose(fault: str, source: Int[np.ndarray, "V"], target: Int[np.ndarray, "V"]) -> Hypothesis:
        moved = c2w.copy()
        moved[target] = c2w[source]
        return Hypothesis(fault, "give each photo its own pose", moved[indices])

    for order in (alphabetical, numeric):
        for step, where in ((1, "before"), (-1, "after")):
            # Read: each photo has the pose of the one before it; so its own is at the next.
            fault = f"poses that are those of the photos {where} them in the order of names"
            yield suppose(fault, np.roll(order, -step), order)
        yield suppose("poses in the reverse order of the photos", order[::-1], order)
    fault = "poses in another order than the photos, whose names sort otherwise as numbers (2, 10) than as text (10, 2)"
    if (alphabetical != numeric).any():
        yield suppose(fault, alphabetical, numeric)
        yield suppose(fault, numeric, alphabetical)
