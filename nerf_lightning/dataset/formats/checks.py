"""Checks that all loaders share. Each raises InputError: one line that a user can act on.

Files come from strangers: nothing here unpickles or evaluates anything.
"""

import logging
import math
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8

from nerf_lightning.cameras import axes_meet, focus_point
from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import Header, read_json

log = logging.getLogger(__name__)

PIXEL_BYTES = 20
"""Memory for a pixel of a rendered view: colour, depth and opacity as floats."""
RIGID_TOLERANCE = 1e-3
"""How far R^T R may stand from the identity, entry by entry; files that print six digits stay well below."""

FARTHEST, NEAREST = 1e12, 1e-12
"""Largest coordinate, and smallest distance of cameras from what they look at, in a file's unit: single precision holds the
cubes of these lengths, which a similarity's scale is taken from, and no more."""
PIXELS = 2.0**23
"""Largest focal length, and largest place on a sensor, pixels. Directions have length 1 and a pixel is 1 / focal length wide:
single precision cannot tell the directions of two pixels beyond, nor their places."""
STEP = 2.0**-23
"""Between neighbouring numbers of single precision, as a share of them."""
ROUNDING = 1e-13
"""Cameras nearer than this share of their coordinates stand on one spot, but for the rounding of double precision."""


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


def focal_length(where: object, key: str, value: float, side: float) -> float:
    """Pixels, of a photo with that many along this side: directions of its pixels must differ, the outermost still point ahead.

    Raises:
        InputError: where single precision could not hold that.
    """
    least = side / PIXELS
    if not least <= value <= PIXELS:
        expected = f"a focal length of {least:.2g} to {PIXELS:.0f} pixels"
        raise InputError(where, key, f"{value:g}", expected, "is it in pixels?")
    return value


def field_of_view(where: object, key: str, angle: float, side: int, fisheye: bool = False) -> float:
    """The focal length in pixels of a photo that shows this angle, radians, along a side."""
    if not 0 < angle < math.pi:
        raise InputError(where, key, f"{angle:g}", "radians between 0 and pi")
    wide = angle if fisheye else 2 * math.tan(0.5 * angle)
    if not side / PIXELS <= wide <= PIXELS:
        raise InputError(where, key, f"{angle:g}", "the angle that a photo shows, in radians")
    return side / wide


def sensor(where: object, key: str, place: float) -> float:
    """A place on the sensor, or a skew, in pixels: whole ones must differ."""
    if not abs(place) <= PIXELS:
        raise InputError(where, key, f"{place:g}", f"at most {PIXELS:.0f} pixels from the photo's corner")
    return place


def principal_point(where: object, key: str, cx: float, cy: float, width: float, height: float) -> None:
    """Refuses a principal point that is the middle of photos of another size.

    Raises:
        InputError: it lies as many times farther than the middle along both axes.
    """
    across, down = 2 * cx / width, 2 * cy / height
    if min(across, down) > 1.8 and abs(across / down - 1) < 0.25:
        found = f"{cx:g}, {cy:g}, the middle of photos {across:.3g} times as large as these, of {width:g}x{height:g}"
        raise InputError(where, key, found, "intrinsics of these photos", "give w and h of the photos they belong to")


def numeric(where: object, key: str, array: Shaped[np.ndarray, "..."], shape: str) -> Float[np.ndarray, "..."]:
    """The array as float64; `shape` is what it must have, like "4 4"."""
    wanted = f"numbers of shape ({', '.join(shape.split())})"
    if list(array.shape) != [int(size) for size in shape.split()]:
        raise InputError(where, key, f"shape {array.shape}", wanted)
    if array.dtype.kind not in "iuf":
        raise InputError(where, key, f"dtype {array.dtype}", wanted)
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        raise InputError(where, key, "nan or infinity", f"finite {wanted}")
    return array


def pose_array(where: object, key: str, array: Header | np.ndarray) -> None:
    """Whether an array can be poses, by its shape and type."""
    if len(array.shape) != 3 or array.shape[1:] != (4, 4) or array.dtype.kind not in "iuf":
        found = f"shape {array.shape}, {array.dtype}"
        raise InputError(where, key, found, "camera-to-world matrices of shape (V, 4, 4)")


def rigid_poses(where: object, label: str, poses: Shaped[np.ndarray, "V ..."]) -> Float[np.ndarray, "V 4 4"]:
    """Camera-to-world matrices [R t; 0 1] with R a rotation. `label` names pose i in messages: "c2ws_train[{}]".

    A uniform scale in the rotations is divided out; a line says so.
    """
    pose_array(where, label.replace("[{}]", ""), poses)
    scales = [uniform_scale(pose) for pose in poses.astype(np.float64)]
    if scaled := [scale for scale in scales if abs(scale - 1) > RIGID_TOLERANCE]:
        text = "%s: %d of %d rotations carry a uniform scale, such as %.4g: divided out, camera positions stay"
        log.warning(text, where, len(scaled), len(scales), scaled[0])
    return np.stack([rigid_pose(where, label.format(i), pose) for i, pose in enumerate(poses.astype(np.float64))])


@np.errstate(over="ignore", invalid="ignore")
def uniform_scale(pose: Float[np.ndarray, "4 4"]) -> float:
    """The factor by which all columns of a pose's rotation are longer than 1; 1 where they are not of one length."""
    lengths = np.linalg.norm(pose[:3, :3], axis=0)
    mean = float(lengths.mean())
    is_uniform = math.isfinite(mean) and NEAREST < mean < FARTHEST and np.ptp(lengths) <= RIGID_TOLERANCE * mean
    return mean if is_uniform else 1.0


@np.errstate(over="ignore")
def rigid_pose(where: object, key: str, pose: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
    """One camera-to-world matrix, likewise; without a line."""
    expected = "a finite camera-to-world matrix [R t; 0 0 0 1] with R a rotation"
    found = todo = ""
    if np.isfinite(pose).all() and abs((scale := uniform_scale(pose)) - 1) > RIGID_TOLERANCE:
        pose = np.concatenate([pose[:, :3] / scale, pose[:, 3:]], axis=1)
    if not np.isfinite(pose).all():
        found, todo = "nan or infinity", "leave out views without a pose"
    elif not np.allclose(pose[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE):
        found, todo = f"bottom row {rounded(pose[3])}", "the matrix may be transposed"
    elif (error := off_rotation(pose[:3, :3])) > RIGID_TOLERANCE:
        found = f"R^T R that is {error:.2g} away from the identity"
        todo = "the rotation may carry a shear or a scale of its own for each axis: export poses without it"
    elif np.linalg.det(pose[:3, :3]) < 0:
        found, todo = "a mirror (det R = -1)", "the handedness of the axes may be wrong"
    elif (far := np.abs(pose[:3, 3]).max()) > FARTHEST:
        found, expected = f"a camera at {far:.3g}", f"coordinates of at most {FARTHEST:g}"
        todo = "leave it out, or take a larger unit"
    if found:
        raise InputError(where, key, found, expected, todo)
    return pose


def off_rotation(matrix: Float[np.ndarray, "3 3"]) -> float:
    """How far R^T R stands from the identity; a column's length says it where squares would be infinite."""
    longest = np.abs(matrix).max()
    return float(longest if longest > 1e6 else np.abs(matrix.T @ matrix - np.eye(3)).max())


def told_apart(where: object, c2w: Float[np.ndarray, "V 4 4"]) -> None:
    """Checks that cameras' distance from what they look at is one that single precision can hold.

    Args:
        where: the file.
        c2w: of cameras, in its frame.

    Raises:
        InputError: it is not; in any frame whose origin is the subject.
    """
    distance = measure_distance(c2w)
    if distance is not None and not NEAREST <= distance <= FARTHEST:
        found, expected = f"cameras {distance:.3g} from what they look at", f"a distance of {NEAREST:g} to {FARTHEST:g}"
        raise InputError(where, "poses", found, expected, "take another unit")


def is_precise(c2w: Float[np.ndarray, "V 4 4"], focal: Float[np.ndarray, "V"]) -> bool:
    """Whether single precision tells apart what pixels show in the file's own frame, far from whose origin the subject may be.

    Args:
        c2w: of cameras, in the file's frame.
        focal: their focal lengths, pixels.
    """
    distance, far = measure_distance(c2w), float(np.abs(c2w[:, :3, 3]).max())
    return distance is None or (NEAREST <= distance <= FARTHEST and far * STEP <= distance / float(np.median(focal)))


def measure_distance(c2w: Float[np.ndarray, "V 4 4"]) -> float | None:
    """Median distance of cameras from where their axes meet; None where nothing says how far the subject is."""
    if len(c2w) < 3:
        return None
    poses, places = torch.from_numpy(c2w), c2w[:, :3, 3]
    if np.ptp(places, axis=0).max() <= ROUNDING * np.abs(places).max() or not axes_meet(poses):
        return None  # a fly-through or a panorama
    return float((poses[:, :3, 3] - focus_point(poses)).abs().amax(1).median())


def similarity(where: object, key: str, matrix: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "4 4"]:
    """[s R t; 0 1] with R a rotation and s a positive scale."""
    matrix = numeric(where, key, matrix, "4 4")
    expected = "a similarity [s R t; 0 0 0 1]: a rotation times a scale, and a shift"
    turn = np.clip(matrix[:3, :3], -2 * FARTHEST, 2 * FARTHEST)
    scale = float(np.linalg.norm(turn, axis=0).mean())
    if not NEAREST <= scale <= FARTHEST or np.abs(matrix[:3, 3]).max() > FARTHEST:
        found, expected = "a scale or a shift that no file's unit has", f"{expected} of at most {FARTHEST:g}"
    elif np.linalg.det(turn / scale) <= 0 or off_rotation(turn / scale) > RIGID_TOLERANCE:
        found = rounded(turn)
    elif not np.allclose(matrix[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE):
        found = f"bottom row {rounded(matrix[3])}"
    else:
        return matrix
    raise InputError(where, key, found, expected, "leave it out, and the frame is the file's own")


def colour(where: object, key: str, value: Shaped[np.ndarray, "..."]) -> tuple[float, float, float]:
    """sRGB in [0, 1]."""
    red, green, blue = numeric(where, key, value, "3").tolist()
    if not all(0 <= part <= 1 for part in (red, green, blue)):
        raise InputError(where, key, str([red, green, blue]), "three numbers from 0 to 1")
    return red, green, blue


def image_array(where: object, key: str, array: Header) -> None:
    """Whether an array can be images, by its shape and type."""
    if len(array.shape) != 4 or array.shape[3] not in (3, 4) or 0 in array.shape[1:3]:
        raise InputError(where, key, f"shape {array.shape}", "images of shape (V, H, W, 3 or 4)")
    if array.dtype != np.uint8 and array.dtype.kind != "f":
        raise InputError(where, key, f"dtype {array.dtype}", "uint8, or floats in [0, 1]")


def uint8_images(where: object, key: str, images: Shaped[np.ndarray, "V H W C"]) -> UInt8[np.ndarray, "V H W C"]:
    """Images as uint8; floats in [0, 1] are scaled and rounded."""
    if images.dtype == np.uint8:
        return images
    if images.size and not (images.min() >= 0 and images.max() <= 1):  # false for nan too
        raise InputError(where, key, f"floats from {images.min():g} to {images.max():g}", "uint8, or floats in [0, 1]")
    return np.rint(images * 255).astype(np.uint8)


def image_size(where: object, key: str, found_size: tuple[int, ...], size: tuple[int, ...]) -> None:
    """All images of a scene share one (H, W, C)."""
    if found_size != size:
        found = "{1}x{0} with {2} channels".format(*found_size)
        wanted = "{1}x{0} with {2} channels".format(*size)
        raise InputError(where, key, found, f"{wanted}, as in the first image", "bring all images to one size")


def split_size(where: object, key: str, count: int, poses: int | None = None) -> None:
    """At least one view in a split, and as many poses as images."""
    if count == 0:
        raise InputError(where, key, "0 views", "at least one", "a scene needs training and held-out views")
    if poses is not None and count != poses:
        raise InputError(where, key, f"{count} images for {poses} poses", "one pose for each image")


def rounded(found: np.ndarray) -> str:
    """Numbers for a message, in four decimals. NumPy's own rounding multiplies, and makes infinities of large ones."""
    return str(np.vectorize(lambda number: round(number, 4), otypes=[object])(found.astype(object)).tolist())


def intrinsics(
    where: object, key: str, K: Shaped[np.ndarray, "..."], width: int, height: int
) -> Float[np.ndarray, "3 3"]:
    K = numeric(where, key, K, "3 3")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        expected = "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0"
        raise InputError(where, key, rounded(K), expected)
    for side, (row, focal) in zip((width, height), ((0, K[0, 0]), (1, K[1, 1])), strict=True):
        focal_length(where, f"{key}[{row}][{row}]", float(focal), side)
        for column in range(row + 1, 3):
            sensor(where, f"{key}[{row}][{column}]", float(K[row, column]))
    return K


def near_far(where: object, near: float | None, far: float | None) -> None:
    for key, distance in (("near", near), ("far", far)):
        if distance is not None and not 0 <= distance <= FARTHEST:
            raise InputError(where, key, f"{distance:g}", f"a distance from 0 to {FARTHEST:g}")
    if far is not None and far <= (near or 0.0):
        raise InputError(where, "far", f"{far:g}", f"more than near, {near or 0.0:g}")


def box(where: object, key: str, aabb: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "2 3"]:
    aabb = numeric(where, key, aabb, "2 3")
    if np.abs(aabb).max() > FARTHEST:
        raise InputError(where, key, f"a corner at {np.abs(aabb).max():.3g}", f"coordinates of at most {FARTHEST:g}")
    if not (aabb[1] - aabb[0] > np.abs(aabb).max(0) * STEP + NEAREST).all():
        raise InputError(where, key, rounded(aabb), "a lower corner below the upper one on each axis")
    return aabb


def view_size(where: object, key: str, width: object, height: object) -> tuple[int, int]:
    """Width and height in pixels of views to be rendered, each of which must fit into memory."""
    for side in (width, height):
        if not isinstance(side, int) or isinstance(side, bool) or side < 1:
            raise InputError(where, key, repr(side)[:60], "a width and a height, each at least one pixel")
    assert isinstance(width, int) and isinstance(height, int)  # as was just checked
    check_memory(where, key, f"{width}x{height} pixels", PIXEL_BYTES * width * height)
    return width, height
