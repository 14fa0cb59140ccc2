"""Mistakes that people make with the cameras of a file, and how well each hypothesis explains matches between photos."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from nerf_lightning.cameras import Cameras, Projection, pixel_to_camera
from nerf_lightning.cameras.lenses import to_directions, undistort
from nerf_lightning.dataset.evidence import Pair

MAX_MATCHES = 60
"""Of a pair: more would not tell more."""
TOLERANCE, MIN_TOLERANCE_PX, OF_DISPLACEMENT = 0.012, 1.0, 0.3
"""Distance of a match from where the cameras allow it, as a share of the longest side, its least in pixels, and its most as a
share of how far the pair's matches are displaced."""
MIN_DEPTH = 0.5
"""Of what photos show, in distances between the two cameras."""
FLIP = np.diag([1.0, -1.0, -1.0])
"""Camera axes of OpenGL in OpenCV's, and the reverse."""
ZOOMS = tuple(2.0 ** (step / 8) for step in range(-32, 57) if step)
"""Focal lengths that are tried, in those given: lenses in millimetres are up to a hundred times too short."""


SIDEWAYS = "turn them, as dataset.orientation=exif does where their EXIF data say so"
"""What to do about photos that lie on their sides."""


@dataclass(frozen=True)
class Hypothesis:
    """Cameras that a file may mean, and what is wrong with it if it does."""

    found: str
    todo: str
    c2w: Float[np.ndarray, "V 4 4"]
    """OpenCV; in no particular world frame, as only relative poses count. Mirrored cameras have det R = -1."""
    zoom: float = 1.0
    """Focal length, in those given."""
    rare: bool = False
    """Whether hardly anybody errs so: it must explain clearly more than the others."""


@dataclass(frozen=True)
class Matches:
    """The matches of P pairs of photos, M in all, as directions in their cameras' frames."""

    views: Int[np.ndarray, "P 2"]
    """Of each pair."""
    pair: Int[np.ndarray, "M"]
    """That each match is of."""
    first: Float[np.ndarray, "M 3"]
    second: Float[np.ndarray, "M 3"]
    """Unit directions in the two cameras' frames."""
    tolerance: Float[np.ndarray, "M"]
    """Radians at the second photo's middle."""
    fisheye: Bool[np.ndarray, "M"]

    @classmethod
    def of(cls, pairs: Sequence[Pair], cameras: Cameras) -> "Matches":
        some = [one.places[:: -(-len(one.places) // MAX_MATCHES)] for one in pairs]
        pair = np.repeat(np.arange(len(pairs)), [len(places) for places in some])
        places = torch.from_numpy(np.concatenate(some)).float()
        views = np.array([(one.first, one.second) for one in pairs])
        first, second = (directions(cameras, views[pair, side], places[:, side]) for side in (0, 1))
        longest, focal = (x.double().numpy()[views[:, 1]] for x in (cameras.sizes.amax(1), cameras.K[:, 0, 0]))
        moved = np.array([one.displacement for one in pairs])
        tolerance = np.minimum((TOLERANCE * longest).clip(MIN_TOLERANCE_PX), OF_DISPLACEMENT * moved) / focal
        bent = np.zeros(len(cameras), bool)
        if cameras.lenses is not None:
            bent = (cameras.lenses.projection == Projection.FISHEYE).numpy()
        return cls(views, pair, first, second, tolerance[pair], bent[views[pair, 1]])


def directions(cameras: Cameras, view: Int[np.ndarray, "M"], places: Float[Tensor, "M 2"]) -> Float[np.ndarray, "M 3"]:
    """Unit directions, camera frame, of places in photos, pixels."""
    index = torch.from_numpy(view)
    local = pixel_to_camera(cameras.K[index], places, torch.ones(len(places)))
    if cameras.lenses is not None:
        lenses = cameras.lenses[index]
        local = to_directions(undistort(local[:, :2], lenses.coefficients), lenses.projection)
    return torch.nn.functional.normalize(local, dim=1).double().numpy()


def explained(
    matches: Matches, c2w: Float[np.ndarray, "V 4 4"], zoom: float = 1.0, tolerance: float = 1.0
) -> Bool[np.ndarray, "M"]:
    """Which matches cameras allow: something before both, no nearer than `MIN_DEPTH`, would appear in both places.

    What the first photo shows at one place draws an arc of a great circle around the second camera as its depth varies; cameras
    on one spot see it in one direction. The angle between that arc and where the second photo shows it must be small.
    """
    cameras = c2w[matches.views]
    back = cameras[:, 1, :3, :3].transpose(0, 2, 1)
    turn, shift = back @ cameras[:, 0, :3, :3], back @ (cameras[:, 0, :3, 3:] - cameras[:, 1, :3, 3:])
    first, second = (_unit(x * [1, 1, zoom]) for x in (matches.first, matches.second))
    farthest = (turn[matches.pair] @ first[..., None])[..., 0]
    nearest = _unit(MIN_DEPTH * farthest + _unit(shift[:, :, 0])[matches.pair])
    normal = _unit(np.cross(farthest, nearest))
    within = (np.cross(farthest, second) * normal).sum(1) >= 0
    within &= (np.cross(second, nearest) * normal).sum(1) >= 0
    beside = np.arcsin(np.abs((second * normal).sum(1)).clip(0, 1))
    ends = np.minimum(
        *(2 * np.arcsin(np.linalg.norm(end - second, axis=1).clip(0, 2) / 2) for end in (farthest, nearest))
    )
    # A pixel far from a pinhole camera's axis shows a smaller angle.
    pixel = np.where(matches.fisheye, 1.0, second[:, 2] ** 2) / zoom * tolerance
    return np.where(within & (normal != 0).any(1), beside, ends) <= matches.tolerance * pixel


def _unit(vectors: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Of length 1, or 0."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / length.clip(1e-9), 0.0)


def posed_by(rotation: Float[np.ndarray, "V 3 3"], centre: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V 4 4"]:
    c2w = np.tile(np.eye(4), (len(rotation), 1, 1))
    c2w[:, :3, :3], c2w[:, :3, 3] = rotation, centre
    return c2w


def axis_changes() -> list[Float[np.ndarray, "3 3"]]:
    """The 48 ways to name three axes: the identity, the other rotations, then mirrors."""
    every = [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
    return sorted(every, key=lambda one: (np.linalg.det(one) < 0, -np.trace(one)))


def convention_hypotheses(c2w: Float[np.ndarray, "V 4 4"]) -> Iterator[Hypothesis]:
    """What other tools' conventions make of poses; the likeliest first.

    Args:
        c2w: as read, OpenCV, in the file's world frame.
    """
    rotation, centre = c2w[:, :3, :3], c2w[:, :3, 3]
    transposed = rotation.transpose(0, 2, 1)
    of_inverse = -(transposed @ centre[..., None])[..., 0]
    changes = axis_changes()[1:]
    axes = "camera axes of the other convention: OpenCV has y down and z forward, OpenGL y up and z backward"
    yield Hypothesis(axes, "negate the second and third column of each rotation", posed_by(rotation @ FLIP, centre))
    inverse = "world-to-camera matrices, where camera-to-world ones belong"
    for flip in (np.eye(3), FLIP):
        yield Hypothesis(inverse, "invert each matrix", posed_by(transposed @ flip, of_inverse))
    for left, right in product((np.eye(3), FLIP), repeat=2):
        found = "transposed rotations beside the cameras' centres"
        yield Hypothesis(found, "transpose each rotation", posed_by(left @ transposed @ right, centre))
    for flip in (np.eye(3), FLIP):
        found = "camera-to-world rotations beside translations of world-to-camera matrices"
        todo = "put the cameras' centres -R t in the fourth column"
        yield Hypothesis(found, todo, posed_by(rotation, -(rotation @ flip @ centre[..., None])[..., 0]))
    for change in changes:
        if np.linalg.det(change) < 0:
            found = "a mirrored world: left-handed axes, or photos that are flipped"
            todo = "negate one axis, of the world and of the cameras, or flip the photos back"
        elif change[2, 2] == 1:
            found, todo = "photos that lie on their sides or upside down in their cameras", SIDEWAYS
        else:
            found, todo = "camera axes in another order", "the columns of a rotation are the camera's axes in the world"
        rare = bool(change[2, 2] != 1)
        yield Hypothesis(found, todo, posed_by(rotation @ change, centre), rare=rare)
        found, todo = f"{inverse}, of other axes", "invert each matrix"
        yield Hypothesis(found, todo, posed_by(transposed @ change, of_inverse), rare=True)
    found, todo = "rotations of quaternions in another order", "the order is w, x, y, z"
    for backward in (False, True):
        for flip in (np.eye(3), FLIP):
            yield Hypothesis(found, todo, posed_by(other_quaternion(rotation @ flip, backward) @ flip, centre))
        turned = other_quaternion(transposed, backward).transpose(
            0, 2, 1
        )  # world-to-camera poses keep their translations
        yield Hypothesis(found, todo, posed_by(turned, -(turned @ of_inverse[..., None])[..., 0]))
    for flip, change in product((np.eye(3), FLIP), changes):
        found, todo = "centres in another world frame than rotations", "turn both alike"
        yield Hypothesis(found, todo, posed_by(rotation @ flip, centre @ change.T), rare=True)


def other_quaternion(rotation: Float[np.ndarray, "V 3 3"], backward: bool) -> Float[np.ndarray, "V 3 3"]:
    """Rotations of the same quaternions, had x, y, z, w been read as w, x, y, z, or in reverse."""
    stored = Rotation.from_matrix(rotation).as_quat()  # x, y, z, w
    return Rotation.from_quat(np.roll(stored, 2 * backward - 1, axis=1)).as_matrix()
