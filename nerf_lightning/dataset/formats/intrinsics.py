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
MIN_ANGLE = 1e-9
"""Of view, radians."""


def read_size(frame: Frame) -> tuple[int, int] | None:
    """Width and height in pixels that a file states for a camera, None where it states none."""
    width, height = frame.number("w"), frame.number("h")
    if width is None or height is None:
        return None
    if not (1 <= width <= checks.PIXELS and 1 <= height <= checks.PIXELS):
        raise InputError(frame.file, f"{frame.key}: w, h", f"{width:g}x{height:g}", "the pixels of a photo")
    return round(width), round(height)


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
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "k3", "p1", "p2")
    for key in REFUSED if fisheye else (*REFUSED, "k4"):
        value = frame.get(key)
        if any(value) if isinstance(value, list) else value not in (None, False, 0, "0"):
            expected = f"at most {', '.join(names)}"
            raise InputError(file, name_key(key), repr(value)[:60], expected, "calibrate or export with these alone")
    found_x, found_y = read_focal(frame, "x", width, fisheye), read_focal(frame, "y", height, fisheye)
    fx, fy = found_x or found_y, found_y or found_x
    if fx is None or fy is None:
        found = f"no focal length among [{', '.join(sorted({**frame.content, **frame.entry}))}]"
        raise InputError(file, name_key("fl_x"), found, "fl_x in pixels or camera_angle_x in radians")
    cx, cy = frame.number("cx"), frame.number("cy")
    cx, cy = width / 2 if cx is None else cx, height / 2 if cy is None else cy
    distortion = Distortion(**{key: frame.number(key) or 0.0 for key in names})
    projection = Projection.FISHEYE if fisheye else Projection.PERSPECTIVE
    return checks.check_optics(file, frame.key, Optics(width, height, fx, fy, cx, cy, distortion, projection))


def read_focal(frame: Frame, axis: str, side: int, fisheye: bool) -> float | None:
    """Focal length along an axis in pixels: `fl_x` first, then `camera_angle_x` in radians, then `x_fov` in degrees.

    Raises:
        InputError: a length or an angle that no camera has.
    """
    file, key, angle_key = frame.file, f"fl_{axis}", f"camera_angle_{axis}"
    given, angle, degrees = frame.number(key), frame.number(angle_key), frame.number(f"{axis}_fov")
    if angle is None and degrees is not None:
        angle, angle_key = math.radians(degrees), f"{axis}_fov"
    if given is not None:
        checks.positive(file, frame.name_key(key), given)
    if angle is None:
        return given
    if not MIN_ANGLE < angle < math.pi:
        todo = f"it seems to be in degrees: write {math.radians(angle):.6g}" if math.pi <= angle < 180 else ""
        raise InputError(file, frame.name_key(angle_key), f"{angle:g}", "an angle in radians, between 0 and pi", todo)
    by_angle = side / (angle if fisheye else 2 * math.tan(0.5 * angle))
    if given is None:
        return by_angle
    if abs(by_angle / given - 1) > MAX_FOCAL_DISAGREEMENT and frame.key == "frames[0]":
        text = "%s: %s=%.5g and the angle of view, which says %.5g, disagree: %s is taken"
        log.warning(text, file, key, given, by_angle, key)
    return given
