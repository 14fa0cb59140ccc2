"""Checks of numbers, intrinsics and poses that all readers share. Each raises InputError: one line that a user can act on."""

import logging
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory

log = logging.getLogger(__name__)

BYTES_PER_RENDERED_PIXEL = 20
"""Memory for a pixel of a rendered view: colour, depth and opacity as floats."""
RIGID_TOLERANCE = 1e-3
"""How far R^T R may stand from the identity, entry by entry; files that print six digits stay well below."""
MAX_COORDINATE, MIN_CAMERA_DISTANCE = 1e12, 1e-12
"""Largest coordinate, and smallest distance of cameras from what they look at, in a file's unit: single precision holds the
cubes of these lengths, which a similarity's scale is taken from, and no more."""
MAX_FOCAL_PX = 2.0**23
"""Largest focal length, and largest place on a sensor: single precision cannot tell two pixels apart beyond."""
FLOAT32_EPS = 2.0**-23
"""Between neighbouring numbers of single precision, as a share of them."""
MIN_CENTRE_RATIO, MAX_ASPECT_ERROR = 1.8, 0.25
"""Least ratio of a principal point to the middle, along both axes alike, that tells of photos of another size."""


def require_keys(where: object, have: Iterable[str], needed: Sequence[str]) -> None:
    have = sorted(have)
    for key in needed:
        if key not in have:
            raise InputError(where, key, "missing", hint=f"keys there: {', '.join(have)}")


def parse_number(where: object, key: str, value: Any) -> float:
    """A finite real number; text that holds one (some exporters write it so) and arrays of one element count."""
    array = parse_floats(where, key, value)
    if isinstance(value, bool) or array.size != 1 or not np.isfinite(array).all():
        raise InputError(where, key, f"{value!r} of shape {array.shape}", "one finite number")
    return float(array.item())


def parse_floats(where: object, key: str, value: Any) -> Float[np.ndarray, "..."]:
    """An array, or nested lists, as float64."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(where, key, f"not numbers in rows of one length ({error})") from error


def parse_array(where: object, key: str, value: Any, *shape: int) -> Float[np.ndarray, "..."]:
    """Finite numbers of a shape, as float64."""
    array = parse_floats(where, key, value)
    if array.shape != shape or not np.isfinite(array).all():
        found = f"shape {array.shape}" if array.shape != shape else "nan or infinity"
        raise InputError(where, key, found, f"finite numbers of shape {shape}")
    return array


@np.errstate(all="ignore")
def check_poses(where: object, label: str, value: Any) -> Float[np.ndarray, "V 4 4"]:
    """Camera-to-world matrices [R t; 0 1], float64, with R a rotation; a uniform scale of R is divided out, and said.

    Args:
        where: the file, for messages.
        label: names pose i in messages: "c2ws_train[{}]".
        value: an array or nested lists.
    """
    expected = "camera-to-world matrices [R t; 0 0 0 1] with R a rotation"
    key = label.replace("[{}]", "")
    poses = parse_floats(where, key, value)
    if poses.shape[1:] != (4, 4):
        raise InputError(where, key, f"shape {poses.shape}", f"{expected}, of shape (V, 4, 4)")
    is_finite = np.isfinite(poses).all((1, 2))
    scale = np.linalg.norm(poses[:, :3, :3], axis=(1, 2)) / np.sqrt(3)
    scaled = np.abs(scale - 1) > RIGID_TOLERANCE
    poses[scaled, :3, :3] /= scale[scaled, None, None]
    problems = {
        "nan or infinity": ~is_finite,
        "another bottom row: is it transposed?": np.abs(poses[:, 3] - [0, 0, 0, 1]).max(1) > RIGID_TOLERANCE,
        "no rotation (R^T R is not 1), but shear or scale": ~is_orthonormal(poses[:, :3, :3]),
        "a mirror (det R = -1): left-handed axes": np.linalg.det(poses[:, :3, :3]) < 0,
        f"a camera farther away than {MAX_COORDINATE:g}": np.abs(poses[:, :3, 3]).max(1) > MAX_COORDINATE,
    }
    for found, wrong in problems.items():
        if wrong.any():
            raise InputError(where, label.format(int(wrong.argmax())), found, expected)
    if scaled.any():
        text = "%s: %d of %d rotations carry a uniform scale, such as %.4g: divided out, camera positions stay"
        log.warning(text, where, scaled.sum(), len(poses), scale[scaled.argmax()])
    return poses


def is_orthonormal(matrices: Float[np.ndarray, "V 3 3"]) -> Bool[np.ndarray, "V"]:
    """Whether R^T R is the identity, for each matrix; false for nan."""
    error = matrices.swapaxes(-1, -2) @ matrices - np.eye(3)
    return np.abs(error).max((-2, -1)) <= RIGID_TOLERANCE


@np.errstate(all="ignore")
def check_similarity(where: object, key: str, value: Any) -> Float[np.ndarray, "4 4"]:
    """[s R t; 0 1] with R a rotation and s a positive scale."""
    matrix = parse_array(where, key, value, 4, 4)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    is_similarity = (
        MIN_CAMERA_DISTANCE <= scale <= MAX_COORDINATE
        and np.abs(matrix[:3, 3]).max() <= MAX_COORDINATE
        and is_orthonormal(matrix[None, :3, :3] / scale)[0]
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE)
    )
    if not is_similarity:
        expected = (
            f"a similarity [s R t; 0 0 0 1]: a rotation times a scale, and a shift, of at most {MAX_COORDINATE:g}"
        )
        raise InputError(where, key, str(matrix.tolist()), expected, "leave it out: the frame is the file's own")
    return matrix


def check_split_size(where: object, key: str, count: int) -> None:
    if count == 0:
        raise InputError(where, key, "0 views", "at least one", "a scene needs training and held-out views")


def check_camera(where: object, key: str, intrinsics: Intrinsics) -> Intrinsics:
    """The optics, if a camera can have its size, intrinsics and distortion."""
    o = intrinsics
    if not (1 <= o.width <= MAX_FOCAL_PX and 1 <= o.height <= MAX_FOCAL_PX):
        raise InputError(where, key, f"{o.width:g}x{o.height:g} pixels", "the size of a photo")
    check_intrinsics(where, key, o.K, o.width, o.height)
    if not o.is_invertible():
        found = ", ".join(f"{name}={value:g}" for name, value in o.distortion._asdict().items() if value)
        raise InputError(where, key, f"a distortion that folds the photo over ({found})", "that of a real lens")
    return intrinsics


def check_intrinsics(where: object, key: str, value: Any, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    """A matrix K in pixels of photos of a size, if directions of their pixels differ in single precision.

    A principal point that is the middle of photos of another size, as far off along both axes, is refused too.
    """
    K = parse_array(where, key, value, 3, 3)
    if K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise InputError(where, key, str(K.tolist()), "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels")
    least = max(width, height) / MAX_FOCAL_PX
    if not min(K[0, 0], K[1, 1]) >= least or np.abs(K).max() > MAX_FOCAL_PX:
        expected = f"focal lengths of at least {least:.2g} pixels, none of these numbers above {MAX_FOCAL_PX:.0f}"
        raise InputError(where, key, str(K.tolist()), expected, "are they in pixels?")
    across, down = 2 * K[0, 2] / width, 2 * K[1, 2] / height
    if min(across, down) > MIN_CENTRE_RATIO and abs(across / down - 1) < MAX_ASPECT_ERROR:
        found = (
            f"{K[0, 2]:g}, {K[1, 2]:g}, the middle of photos {across:.3g} times as large as these, of {width}x{height}"
        )
        raise InputError(where, key, found, "intrinsics of these photos", "give w and h of the photos they belong to")
    return K


def check_near_far(where: object, near: float | None, far: float | None) -> None:
    for key, distance in (("near", near), ("far", far)):
        if distance is not None and not 0 <= distance <= MAX_COORDINATE:
            raise InputError(where, key, f"{distance:g}", f"a distance from 0 to {MAX_COORDINATE:g}")
    if far is not None and far <= (near or 0.0):
        raise InputError(where, "far", f"{far:g}", f"more than near, {near or 0.0:g}")


def check_box(where: object, key: str, value: Any) -> Float[np.ndarray, "2 3"]:
    aabb = parse_array(where, key, value, 2, 3)
    low, high = aabb.astype(np.float32)  # as it will be used
    if np.abs(aabb).max() > MAX_COORDINATE or not (high - low > MIN_CAMERA_DISTANCE).all():
        expected = f"a lower corner below the upper one on each axis, coordinates of at most {MAX_COORDINATE:g}"
        raise InputError(where, key, str(aabb.tolist()), expected)
    return aabb


def check_view_size(where: object, key: str, width: object, height: object) -> tuple[int, int]:
    """Width and height in pixels of views to be rendered, each of which must fit into memory."""
    for side in (width, height):
        if not isinstance(side, int) or isinstance(side, bool) or side < 1:
            raise InputError(where, key, repr(side)[:60], "a width and a height, each at least one pixel")
    assert isinstance(width, int) and isinstance(height, int)  # as was just checked
    check_memory(where, key, f"{width}x{height} pixels", BYTES_PER_RENDERED_PIXEL * width * height)
    return width, height
