"""Checks that all loaders share. Each raises InputError: one line that a user can act on."""

import logging
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from nerf_lightning.dataset.optics import Optics
from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import read_json

log = logging.getLogger(__name__)

PIXEL_BYTES = 20
"""Memory for a pixel of a rendered view: colour, depth and opacity as floats."""
RIGID_TOLERANCE = 1e-3
"""How far R^T R may stand from the identity, entry by entry; files that print six digits stay well below."""
FARTHEST, NEAREST = 1e12, 1e-12
"""Largest coordinate, and smallest distance of cameras from what they look at, in a file's unit: single precision holds the
cubes of these lengths, which a similarity's scale is taken from, and no more."""
PIXELS = 2.0**23
"""Largest focal length, and largest place on a sensor, pixels: single precision cannot tell two pixels apart beyond."""
STEP = 2.0**-23
"""Between neighbouring numbers of single precision, as a share of them."""
MIN_OTHER_SIZE, MAX_ASPECT_ERROR = 1.8, 0.25
"""Least ratio of a principal point to the middle, along both axes alike, that tells of photos of another size."""


def json_object(path: Path) -> dict:
    """What a JSON file holds, if that is an object."""
    content = read_json(path, "a JSON object", "mend it or export again")
    if not isinstance(content, dict):
        raise InputError(path, "", f"a JSON {type(content).__name__}", "a JSON object with frames")
    return content


def require_keys(where: object, have: Iterable[str], needed: Sequence[str]) -> None:
    have = sorted(have)
    for key in needed:
        if key not in have:
            raise InputError(where, key, f"no such key among [{', '.join(have)}]", f"all of {', '.join(needed)}")


def number(where: object, key: str, value: object) -> float:
    """A finite real number; 0-d arrays and arrays of one element count."""
    if isinstance(value, np.ndarray) and value.size == 1 and value.dtype.kind in "iuf":
        value = value.item()
    if isinstance(value, str):  # some exporters write numbers as text
        with suppress(ValueError):
            value = float(value)
    # JSON may hold integers too large for a float: the comparison catches them, and nan and infinity.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= 1e300:
        found = f"shape {value.shape}, {value.dtype}" if isinstance(value, np.ndarray) else repr(value)[:60]
        raise InputError(where, key, found, "one finite number")
    return float(value)


def positive(where: object, key: str, value: object, unit: str = "pixels") -> float:
    value = number(where, key, value)
    if value <= 0:
        raise InputError(where, key, f"{value:g}", f"a positive number of {unit}")
    return value


def numeric(where: object, key: str, array: Shaped[np.ndarray, "..."], shape: str) -> Float[np.ndarray, "..."]:
    """The array as float64; `shape` is what it must have, like "4 4"."""
    wanted = f"finite numbers of shape ({', '.join(shape.split())})"
    if list(array.shape) != [int(size) for size in shape.split()] or array.dtype.kind not in "iuf":
        raise InputError(where, key, f"shape {array.shape}, {array.dtype}", wanted)
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(where, key, "nan or infinity", wanted)
    return array


def matrix(where: object, key: str, rows: object) -> Float[np.ndarray, "4 4"]:
    """A matrix of a JSON file, of 3 or 4 rows of 4 numbers; the fourth row is 0 0 0 1 if absent."""
    try:
        found = np.array(rows, dtype=np.float64)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(where, key, f"no matrix ({error})", "4 rows of 4 numbers") from error
    if found.shape not in ((4, 4), (3, 4)):
        raise InputError(where, key, f"shape {found.shape}", "4 rows of 4 numbers")
    return found if len(found) == 4 else np.concatenate([found, [[0.0, 0.0, 0.0, 1.0]]])


@np.errstate(all="ignore")
def rigid_poses(where: object, label: str, poses: Shaped[np.ndarray, "V ..."]) -> Float[np.ndarray, "V 4 4"]:
    """Camera-to-world matrices [R t; 0 1] with R a rotation. `label` names pose i in messages: "c2ws_train[{}]".

    A uniform scale in the rotations is divided out; a line says so.
    """
    expected = "camera-to-world matrices [R t; 0 0 0 1] with R a rotation"
    if poses.shape[1:] != (4, 4) or poses.dtype.kind not in "iuf":
        found = f"shape {poses.shape}, {poses.dtype}"
        raise InputError(where, label.replace("[{}]", ""), found, f"{expected}, of shape (V, 4, 4)")
    poses = poses.astype(np.float64)
    lengths = np.linalg.norm(poses[:, :3, :3], axis=1)
    scale = lengths.mean(1)
    is_uniform = (scale > NEAREST) & (scale < FARTHEST) & (np.ptp(lengths, axis=1) <= RIGID_TOLERANCE * scale)
    scaled = is_uniform & (np.abs(scale - 1) > RIGID_TOLERANCE)
    if scaled.any():
        text = "%s: %d of %d rotations carry a uniform scale, such as %.4g: divided out, camera positions stay"
        log.warning(text, where, scaled.sum(), len(poses), scale[scaled.argmax()])
        poses[scaled, :3, :3] /= scale[scaled, None, None]
    error = off_rotation(poses[:, :3, :3])
    far = np.abs(poses[:, :3, 3]).max(1)
    for wrong, found, todo in (
        (~np.isfinite(poses).all((1, 2)), "nan or infinity", "leave out views without a pose"),
        (
            np.abs(poses[:, 3] - [0, 0, 0, 1]).max(1) > RIGID_TOLERANCE,
            "another bottom row",
            "is the matrix transposed?",
        ),
        (~(error <= RIGID_TOLERANCE), "no rotation (R^T R is not 1)", "export poses without shear and scale"),
        (np.linalg.det(poses[:, :3, :3]) < 0, "a mirror (det R = -1)", "is the handedness of the axes right?"),
        (far > FARTHEST, f"a camera at {far.max():.3g}", f"leave it out: coordinates are at most {FARTHEST:g}"),
    ):
        if wrong.any():
            raise InputError(where, label.format(int(wrong.argmax())), found, expected, todo)
    return poses


@np.errstate(all="ignore")
def off_rotation(matrices: Float[np.ndarray, "V 3 3"]) -> Float[np.ndarray, "V"]:
    """How far R^T R stands from the identity, entry by entry; not a number where it is too large to say."""
    return np.abs(matrices.swapaxes(-1, -2) @ matrices - np.eye(3)).max((-2, -1))


@np.errstate(all="ignore")
def similarity(where: object, key: str, matrix: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "4 4"]:
    """[s R t; 0 1] with R a rotation and s a positive scale."""
    matrix = numeric(where, key, matrix, "4 4")
    turn = matrix[:3, :3]
    scale = float(np.linalg.norm(turn, axis=0).mean())
    is_similarity = (
        NEAREST <= scale <= FARTHEST
        and np.abs(matrix[:3, 3]).max() <= FARTHEST
        and np.linalg.det(turn / scale) > 0
        and off_rotation(turn[None] / scale)[0] <= RIGID_TOLERANCE
        and np.allclose(matrix[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE)
    )
    if not is_similarity:
        expected = f"a similarity [s R t; 0 0 0 1]: a rotation times a scale, and a shift, of at most {FARTHEST:g}"
        raise InputError(where, key, str(matrix.tolist()), expected, "leave it out: the frame is the file's own")
    return matrix


def split_size(where: object, key: str, count: int, poses: int | None = None) -> None:
    """At least one view in a split, and as many poses as images."""
    if count == 0:
        raise InputError(where, key, "0 views", "at least one", "a scene needs training and held-out views")
    if poses is not None and count != poses:
        raise InputError(where, key, f"{count} images for {poses} poses", "one pose for each image")


def focal_length(where: object, key: str, value: float, side: float) -> float:
    """Pixels, of a photo with that many along this side: directions of its pixels must differ, the outermost point ahead."""
    if not side / PIXELS <= value <= PIXELS:
        expected = f"a focal length of {side / PIXELS:.2g} to {PIXELS:.0f} pixels"
        raise InputError(where, key, f"{value:g}", expected, "is it in pixels?")
    return value


def check_optics(where: object, key: str, optics: Optics) -> Optics:
    """The optics, if a camera can have them.

    Raises:
        InputError: a size, focal length, principal point or distortion that no camera has, or a principal point that is the
            middle of photos of another size.
    """
    o = optics
    if not (1 <= o.width <= PIXELS and 1 <= o.height <= PIXELS):
        raise InputError(where, key, f"{o.width:g}x{o.height:g} pixels", "the size of a photo")
    for focal, side in ((o.fx, o.width), (o.fy, o.height)):
        focal_length(where, key, focal, side)
    check_principal_point(where, key, o.cx, o.cy, o.width, o.height)
    if not o.sees_every_pixel():
        found = ", ".join(f"{name}={value:g}" for name, value in o.distortion._asdict().items() if value)
        raise InputError(where, key, f"a distortion that folds the photo over ({found})", "that of a real lens")
    return optics


def check_principal_point(where: object, key: str, cx: float, cy: float, width: float, height: float) -> None:
    """Refuses one that is beyond any sensor, or the middle of photos of another size: as far off along both axes."""
    if not max(abs(cx), abs(cy)) <= PIXELS:
        raise InputError(where, key, f"{cx:g}, {cy:g}", f"a principal point of at most {PIXELS:.0f} pixels")
    across, down = 2 * cx / width, 2 * cy / height
    if min(across, down) > MIN_OTHER_SIZE and abs(across / down - 1) < MAX_ASPECT_ERROR:
        found = f"{cx:g}, {cy:g}, the middle of photos {across:.3g} times as large as these, of {width:g}x{height:g}"
        raise InputError(where, key, found, "intrinsics of these photos", "give w and h of the photos they belong to")


def intrinsics(
    where: object, key: str, K: Shaped[np.ndarray, "..."], width: int, height: int
) -> Float[np.ndarray, "3 3"]:
    K = numeric(where, key, K, "3 3")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        expected = "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0"
        raise InputError(where, key, str(K.tolist()), expected)
    for focal, side in ((K[0, 0], width), (K[1, 1], height)):
        focal_length(where, key, float(focal), side)
    if not np.abs(K).max() <= PIXELS:
        raise InputError(where, key, str(K.tolist()), f"skew and principal point of at most {PIXELS:.0f} pixels")
    return K


def near_far(where: object, near: float | None, far: float | None) -> None:
    for key, distance in (("near", near), ("far", far)):
        if distance is not None and not 0 <= distance <= FARTHEST:
            raise InputError(where, key, f"{distance:g}", f"a distance from 0 to {FARTHEST:g}")
    if far is not None and far <= (near or 0.0):
        raise InputError(where, "far", f"{far:g}", f"more than near, {near or 0.0:g}")


def box(where: object, key: str, aabb: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "2 3"]:
    aabb = numeric(where, key, aabb, "2 3")
    size = np.abs(aabb).max(0)
    if size.max() > FARTHEST or not (aabb[1] - aabb[0] > size * STEP + NEAREST).all():
        expected = f"a lower corner below the upper one on each axis, coordinates of at most {FARTHEST:g}"
        raise InputError(where, key, str(aabb.tolist()), expected)
    return aabb


def view_size(where: object, key: str, width: object, height: object) -> tuple[int, int]:
    """Width and height in pixels of views to be rendered, each of which must fit into memory."""
    for side in (width, height):
        if not isinstance(side, int) or isinstance(side, bool) or side < 1:
            raise InputError(where, key, repr(side)[:60], "a width and a height, each at least one pixel")
    assert isinstance(width, int) and isinstance(height, int)  # as was just checked
    check_memory(where, key, f"{width}x{height} pixels", PIXEL_BYTES * width * height)
    return width, height
