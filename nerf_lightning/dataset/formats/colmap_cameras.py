"""COLMAP's camera models (https://colmap.github.io/cameras.html)."""

from nerf_lightning.cameras import Distortion, Projection
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.optics import Optics, field_of_view_lens
from nerf_lightning.errors import InputError

MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4),
}  # fmt: skip
"""Name and number of parameters of each camera model that is read, by COLMAP's number."""
NUMBERS = {name: number for number, (name, _) in MODELS.items()}


def optics_of(where: object, key: str, name: str, width: int, height: int, p: tuple[float, ...]) -> Optics:
    """A camera in COLMAP's terms.

    Raises:
        InputError: sizes or numbers that no camera has.
    """
    one_focal = name in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_FISHEYE") or name.endswith(
        "RADIAL_FISHEYE"
    )
    fx, fy, cx, cy, *more = (p[0], *p) if one_focal else p
    projection = Projection.FISHEYE if "FISHEYE" in name else Projection.PERSPECTIVE
    if name == "FOV":
        checks.check_optics(where, key, Optics(width, height, fx, fy, cx, cy))
        found = field_of_view_lens(width, height, fx, fy, cx, cy, more[0])
        if found is None:
            raise InputError(where, key, f"FOV with {p}", "a field of view that the photo fits into")
        return found
    if name == "OPENCV_FISHEYE":
        distortion = Distortion(*more)
    elif name in ("OPENCV", "FULL_OPENCV", "THIN_PRISM_FISHEYE"):
        k1, k2, p1, p2, *rest = more
        distortion = Distortion(k1=k1, k2=k2, p1=p1, p2=p2)
        if name == "FULL_OPENCV":
            distortion = distortion._replace(k3=rest[0], d1=rest[1], d2=rest[2], d3=rest[3])
        elif rest:
            distortion = distortion._replace(k3=rest[0], k4=rest[1], s1=rest[2], s2=rest[3])
    else:
        distortion = Distortion(*more)
    return checks.check_optics(where, key, Optics(width, height, fx, fy, cx, cy, distortion, projection))
