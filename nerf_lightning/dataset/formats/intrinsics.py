"""The camera of a frame of transforms.json: intrinsics and lens."""

import logging
import math

from nerf_lightning.cameras import Distortion, Projection
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.frames import REFUSED, Frame
from nerf_lightning.dataset.optics import Optics, equirectangular
from nerf_lightning.errors import InputError

log = logging.getLogger(__name__)

PERSPECTIVE = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "PERSPECTIVE")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE")
EQUIRECTANGULAR = "EQUIRECTANGULAR"
MAX_FOCAL_DISAGREEMENT = 0.02
"""Most relative difference of a focal length and an angle of view that say the same."""


def read_size(frame: Frame) -> tuple[int, int] | None:
    """Width and height in pixels that a file states for a camera, None where it states none."""
    sides = [frame.number(key) for key in ("w", "h")]
    if None in sides:
        return None
    for key, side in zip(("w", "h"), sides, strict=True):
        if not side or not 1 <= side <= checks.PIXELS:
            raise InputError(frame.file, frame.name_key(key), f"{side:g}", "the pixels of a photo")
    width, height = (max(1, round(side)) for side in sides if side)
    return width, height


def read_optics(frame: Frame, width: int, height: int) -> Optics:
    """Intrinsics of one frame for photos of a size, in pixels of that size.

    Raises:
        InputError: no focal length, or a lens that is not known here.
    """
    file, name_key = frame.file, frame.name_key
    model = frame.get("camera_model") or "OPENCV"
    if model == EQUIRECTANGULAR:
        if abs(width - 2 * height) > 2:
            found, expected = f"{model} of {width}x{height} pixels", "photos twice as wide as high, of all directions"
            raise InputError(file, name_key("camera_model"), found, expected)
        return equirectangular(width, height)
    if model not in (*PERSPECTIVE, *FISHEYE):
        expected = f"one of {', '.join((*PERSPECTIVE, *FISHEYE, EQUIRECTANGULAR))}"
        raise InputError(file, name_key("camera_model"), repr(model)[:60], expected)
    fisheye = model in FISHEYE or bool(frame.get("is_fisheye"))
    for key in REFUSED if fisheye else (*REFUSED, "k4"):
        value = frame.get(key)
        if any(value) if isinstance(value, list) else value not in (None, False, 0, "0"):
            expected = "at most k1, k2, k3, k4" if fisheye else "at most k1, k2, k3, p1, p2"
            raise InputError(file, name_key(key), repr(value)[:60], expected, "calibrate or export with these alone")
    found_x, found_y = read_focal(frame, "x", width, fisheye), read_focal(frame, "y", height, fisheye)
    fx, fy = found_x or found_y, found_y or found_x
    if fx is None or fy is None:
        found = f"no focal length among [{', '.join(sorted({**frame.content, **frame.entry}))}]"
        raise InputError(file, name_key("fl_x"), found, "fl_x in pixels or camera_angle_x in radians")
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    distortion = Distortion(**{key: frame.number(key) or 0.0 for key in names})
    cx, cy = read_place(frame, "cx", width), read_place(frame, "cy", height)
    checks.principal_point(file, f"{name_key('cx')}, {name_key('cy')}", cx, cy, width, height)
    optics = Optics(
        width, height, fx, fy, cx, cy, distortion, Projection.FISHEYE if fisheye else Projection.PERSPECTIVE
    )
    if not optics.sees_every_pixel():
        expected = "that of a real lens"
        raise InputError(file, ", ".join(map(name_key, names)), "a distortion that folds the photo over", expected)
    return optics


def read_place(frame: Frame, key: str, side: int) -> float:
    """The principal point along a side in pixels; the middle where the file does not state it."""
    given = frame.number(key)
    return side / 2 if given is None else checks.sensor(frame.file, frame.name_key(key), given)


def read_focal(frame: Frame, axis: str, side: int, fisheye: bool) -> float | None:
    """Focal length along an axis in pixels: `fl_x` first, then `camera_angle_x` in radians, then `x_fov` in degrees.

    Raises:
        InputError: a length or an angle that no camera has.
    """
    file, key, angle_key, degrees_key = frame.file, f"fl_{axis}", f"camera_angle_{axis}", f"{axis}_fov"
    angle, degrees = frame.number(angle_key), frame.number(degrees_key)
    by_angle = None
    if angle is not None:
        if math.pi <= angle < 180:
            found, todo = f"{angle:g}", f"it seems to be in degrees: write {math.radians(angle):.6g}"
            raise InputError(file, frame.name_key(angle_key), found, "an angle in radians, below pi", todo)
        by_angle = checks.field_of_view(file, frame.name_key(angle_key), angle, side, fisheye)
    elif degrees is not None:
        by_angle = checks.field_of_view(file, frame.name_key(degrees_key), math.radians(degrees), side, fisheye)
    if (given := frame.number(key)) is None:
        return by_angle
    focal = checks.focal_length(file, frame.name_key(key), checks.positive(file, frame.name_key(key), given), side)
    if by_angle is not None and abs(by_angle / focal - 1) > MAX_FOCAL_DISAGREEMENT and frame.key == "frames[0]":
        text = "%s: %s=%.5g and the angle of view, which says %.5g, disagree: %s is taken"
        log.warning(text, file, key, focal, by_angle, key)
    return focal
