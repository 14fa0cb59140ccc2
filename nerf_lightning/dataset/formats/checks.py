"""Checks that all loaders share. Each raises InputError: one line that a user can act on.

Files come from strangers: nothing here unpickles or evaluates anything.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from nerf_lightning.errors import InputError
from nerf_lightning.utils.arrays import Header
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.untrusted import read_json

PIXEL_BYTES = 20
"""Memory for a pixel of a rendered view: colour, depth and opacity as floats."""
RIGID_TOLERANCE = 1e-3
"""How far R^T R may stand from the identity, entry by entry; files that print six digits stay well below."""


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
    """Camera-to-world matrices [R t; 0 1] with R a rotation. `label` names pose i in messages: "c2ws_train[{}]"."""
    pose_array(where, label.replace("[{}]", ""), poses)
    poses = poses.astype(np.float64)
    expected = "a finite camera-to-world matrix [R t; 0 0 0 1] with R a rotation"
    for i, pose in enumerate(poses):
        found = todo = ""
        if not np.isfinite(pose).all():
            found, todo = "nan or infinity", "leave out views without a pose"
        elif not np.allclose(pose[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE):
            found, todo = f"bottom row {pose[3].round(4).tolist()}", "the matrix may be transposed"
        elif (error := np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max()) > RIGID_TOLERANCE:
            found = f"R^T R that is {error:.2g} away from the identity"
            todo = "the rotation may carry a scale: divide it out"
        elif np.linalg.det(pose[:3, :3]) < 0:
            found, todo = "a mirror (det R = -1)", "the handedness of the axes may be wrong"
        if found:
            raise InputError(where, label.format(i), found, expected, todo)
    return poses


def json_frames(path: Path, content: dict) -> tuple[list[str], Float[np.ndarray, "V 4 4"]]:
    """File names and camera-to-world matrices of `frames`, in the file's own camera convention."""
    require_keys(path, content, ["frames"])
    frames = content["frames"]
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(path, "frames", "something else", "a list of objects with file_path and transform_matrix")
    if not frames:
        raise InputError(path, "frames", "an empty list", "at least one frame")
    poses = []
    for i, frame in enumerate(frames):
        require_keys(f"{path}: frames[{i}]", frame, ["file_path", "transform_matrix"])
        if not isinstance(frame["file_path"], str):
            raise InputError(path, f"frames[{i}].file_path", repr(frame["file_path"])[:60], "a string")
        key = f"frames[{i}].transform_matrix"
        try:
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
        except (ValueError, TypeError, OverflowError) as error:
            raise InputError(path, key, f"no matrix ({error})", "4 rows of 4 numbers") from error
        if pose.shape != (4, 4):
            raise InputError(path, key, f"shape {pose.shape}", "4 rows of 4 numbers")
        poses.append(pose)
    return [frame["file_path"] for frame in frames], rigid_poses(path, "frames[{}].transform_matrix", np.stack(poses))


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


def intrinsics(where: object, key: str, K: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "3 3"]:
    K = numeric(where, key, K, "3 3")
    if K[0, 0] <= 0 or K[1, 1] <= 0 or K[1, 0] != 0 or not np.array_equal(K[2], [0, 0, 1]):
        expected = "[[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels with fx, fy > 0"
        raise InputError(where, key, str(K.round(3).tolist()), expected)
    return K


def near_far(where: object, near: float | None, far: float | None) -> None:
    if near is not None and near < 0:
        raise InputError(where, "near", f"{near:g}", "a distance >= 0")
    if far is not None and far <= (near or 0.0):
        raise InputError(where, "far", f"{far:g}", f"more than near, {near or 0.0:g}")


def box(where: object, key: str, aabb: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "2 3"]:
    aabb = numeric(where, key, aabb, "2 3")
    if not (aabb[0] < aabb[1]).all():
        raise InputError(where, key, str(aabb.round(4).tolist()), "a lower corner below the upper one on each axis")
    return aabb


def similarity(where: object, key: str, matrix: Shaped[np.ndarray, "..."]) -> Float[np.ndarray, "4 4"]:
    """A change of frame that can be undone: [sR t; 0 0 0 1] with a scale s above 0 and no mirror."""
    matrix = numeric(where, key, matrix, "4 4")
    if not (np.allclose(matrix[3], [0, 0, 0, 1], atol=RIGID_TOLERANCE) and np.linalg.det(matrix[:3, :3]) > 0):
        raise InputError(where, key, str(matrix.round(4).tolist()), "[sR t; 0 0 0 1] with a scale s above 0")
    return matrix


def view_size(where: object, key: str, width: object, height: object) -> tuple[int, int]:
    """Width and height in pixels of views to be rendered, each of which must fit into memory."""
    for side in (width, height):
        if not isinstance(side, int) or isinstance(side, bool) or side < 1:
            raise InputError(where, key, repr(side)[:60], "a width and a height, each at least one pixel")
    assert isinstance(width, int) and isinstance(height, int)  # as was just checked
    check_memory(where, key, f"{width}x{height} pixels", PIXEL_BYTES * width * height)
    return width, height
