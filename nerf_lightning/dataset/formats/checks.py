"""Validation of numbers, intrinsics and poses shared by all readers. Each check raises InputError."""

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
"""Memory per rendered pixel: color, depth and opacity as float32."""
RIGID_TOLERANCE = 1e-3
"""Largest deviation of R^T R from the identity, per entry; files with six digits are well below."""
MAX_COORDINATE, MIN_CAMERA_DISTANCE = 1e12, 1e-12
"""Largest coordinate and smallest camera distance, in the file's unit: float32 holds the cubes of these lengths (the
determinants of similarities), but no larger ones."""
MAX_FOCAL_PX = 2.0**23
"""Largest focal length and pixel coordinate: beyond it float32 cannot resolve pixels."""
FLOAT32_EPS = 2.0**-23
"""Relative spacing of float32 numbers."""
MIN_CENTER_RATIO, MAX_ASPECT_ERROR = 1.8, 0.25
"""Minimum ratio of the principal point to the image center, about equal on both axes, that indicates another photo size."""


def require_keys(where: object, have: Iterable[str], needed: Sequence[str]) -> None:
    have = sorted(have)
    for key in needed:
        if key not in have:
            raise InputError(where, key, "missing", hint=f"keys there: {', '.join(have)}")


def parse_number(where: object, key: str, value: Any) -> float:
    """Parses a finite number; accepts strings (as some exporters write) and arrays of one element."""
    array = parse_floats(where, key, value)
    if isinstance(value, bool) or array.size != 1 or not np.isfinite(array).all():
        raise InputError(where, key, f"{value!r} of shape {array.shape}", "one finite number")
    return float(array.item())


def parse_floats(where: object, key: str, value: Any) -> Float[np.ndarray, "..."]:
    """Parses an array or nested lists as float64."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(where, key, f"not numbers in rows of one length ({error})") from error


def parse_array(where: object, key: str, value: Any, *shape: int) -> Float[np.ndarray, "..."]:
    """Parses finite numbers of a shape as float64."""
    array = parse_floats(where, key, value)
    if array.shape != shape or not np.isfinite(array).all():
        found = f"shape {array.shape}" if array.shape != shape else "nan or infinity"
        raise InputError(where, key, found, f"finite numbers of shape {shape}")
    return array


@np.errstate(all="ignore")
def check_poses(where: object, label: str, value: Any) -> Float[np.ndarray, "V 4 4"]:
    """Parses camera-to-world matrices [R t; 0 1] as float64; a uniform scale of R is divided out with a warning.

    Args:
        where: the file, for messages.
        label: name of pose i in messages: "c2ws_train[{}]".
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
        "shear or non-uniform scale (R^T R is not 1)": ~is_orthonormal(poses[:, :3, :3]),
        "a mirror (det R = -1): left-handed axes": np.linalg.det(poses[:, :3, :3]) < 0,
        f"a camera farther away than {MAX_COORDINATE:g}": np.abs(poses[:, :3, 3]).max(1) > MAX_COORDINATE,
    }
    for found, is_invalid in problems.items():
        if is_invalid.any():
            raise InputError(where, label.format(int(is_invalid.argmax())), found, expected)
    if scaled.any():
        text = "%s: %d of %d rotations have a uniform scale, such as %.4g: divided out, camera positions unchanged"
        log.warning(text, where, scaled.sum(), len(poses), scale[scaled.argmax()])
    return poses


def is_orthonormal(matrices: Float[np.ndarray, "V 3 3"]) -> Bool[np.ndarray, "V"]:
    """Whether R^T R is the identity, per matrix; False for NaN."""
    error = matrices.swapaxes(-1, -2) @ matrices - np.eye(3)
    return np.abs(error).max((-2, -1)) <= RIGID_TOLERANCE


@np.errstate(all="ignore")
def check_similarity(where: object, key: str, value: Any) -> Float[np.ndarray, "4 4"]:
    """Parses a similarity [s R t; 0 1] with R a rotation and s > 0."""
    matrix = parse_array(where, key, value, 4, 4)
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    is_similarity = (
        MIN_CAMERA_DISTANCE <= scale <= MAX_COORDINATE
        and np.abs(matrix[:3, 3]).max() <= MAX_COORDINATE
        and is_orthonormal(matrix[None, :3, :3] / scale)[0]
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE)
    )
    if not is_similarity:
        expected = f"a similarity [s R t; 0 0 0 1], with scale and translation of at most {MAX_COORDINATE:g}"
        raise InputError(where, key, str(matrix.tolist()), expected, "or omit it to use the file's frame")
    return matrix


def check_split_size(where: object, key: str, count: int) -> None:
    if count == 0:
        raise InputError(where, key, "0 views", "at least one", "a scene needs training and held-out views")


def check_camera(where: object, key: str, intrinsics: Intrinsics) -> Intrinsics:
    """Checks size, intrinsics and distortion of a camera."""
    width, height = intrinsics.width, intrinsics.height
    if not (1 <= width <= MAX_FOCAL_PX and 1 <= height <= MAX_FOCAL_PX):
        raise InputError(where, key, f"{width:g}x{height:g} pixels", "the size of a photo")
    check_intrinsics(where, key, intrinsics.K, width, height)
    if not intrinsics.is_invertible():
        found = ", ".join(f"{name}={value:g}" for name, value in intrinsics.distortion._asdict().items() if value)
        raise InputError(where, key, f"a distortion that is not invertible ({found})", "that of a real lens")
    return intrinsics


def check_intrinsics(where: object, key: str, value: Any, width: int, height: int) -> Float[np.ndarray, "3 3"]:
    """Parses K, in pixels. Rejects one whose pixels float32 cannot resolve, or that belongs to another photo size."""
    K = parse_array(where, key, value, 3, 3)
    if K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        raise InputError(where, key, str(K.tolist()), "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels")
    least = max(width, height) / MAX_FOCAL_PX
    if not min(K[0, 0], K[1, 1]) >= least or np.abs(K).max() > MAX_FOCAL_PX:
        expected = f"focal lengths of at least {least:.2g} pixels, and no number above {MAX_FOCAL_PX:.0f}"
        raise InputError(where, key, str(K.tolist()), expected, "are they in pixels?")
    ratio_x, ratio_y = 2 * K[0, 2] / width, 2 * K[1, 2] / height
    if min(ratio_x, ratio_y) > MIN_CENTER_RATIO and abs(ratio_x / ratio_y - 1) < MAX_ASPECT_ERROR:
        found = f"{K[0, 2]:g}, {K[1, 2]:g}, the middle of photos {ratio_x:.3g} times the size {width}x{height}"
        raise InputError(where, key, found, "intrinsics of these photos", "give w and h of the calibrated photos")
    return K


def check_near_far(where: object, near: float | None, far: float | None) -> None:
    for key, distance in (("near", near), ("far", far)):
        if distance is not None and not 0 <= distance <= MAX_COORDINATE:
            raise InputError(where, key, f"{distance:g}", f"a distance from 0 to {MAX_COORDINATE:g}")
    if far is not None and far <= (near or 0.0):
        raise InputError(where, "far", f"{far:g}", f"more than near, {near or 0.0:g}")


def check_box(where: object, key: str, value: Any) -> Float[np.ndarray, "2 3"]:
    aabb = parse_array(where, key, value, 2, 3)
    low, high = aabb.astype(np.float32)  # the precision of training
    if np.abs(aabb).max() > MAX_COORDINATE or not (high - low > MIN_CAMERA_DISTANCE).all():
        expected = f"a lower corner below the upper one on each axis, coordinates of at most {MAX_COORDINATE:g}"
        raise InputError(where, key, str(aabb.tolist()), expected)
    return aabb


def check_view_size(where: object, key: str, width: object, height: object) -> tuple[int, int]:
    """Checks the size in pixels of views to render, each of which must fit into memory."""
    for side in (width, height):
        if not isinstance(side, int) or isinstance(side, bool) or side < 1:
            raise InputError(where, key, repr(side)[:60], "a width and a height, each at least one pixel")
    assert isinstance(width, int) and isinstance(height, int)  # for mypy
    check_memory(where, key, f"{width}x{height} pixels", BYTES_PER_RENDERED_PIXEL * width * height)
    return width, height
