"""Camera poses of a synthetic capture: around a sheet of tags, and around an object."""

import itertools

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float

from benchmarks.synthetic.tabletop import Tabletop
from nerf_lightning.cameras import look_at
from nerf_lightning.capture.poses.geometry import apply_pose, invert_pose, normalize_pixels, project_points
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.dataset.intrinsics import Intrinsics

GOLDEN_RATIO = (np.sqrt(5) - 1) / 2
"""Its multiples modulo 1 are a low-discrepancy sequence in [0, 1]."""
MIN_MARGIN_FRACTION = 0.02
"""Margin between a tag and the frame's edge, relative to the frame's width."""
MAX_SHEET_ANGLE_DEG = 45.0
"""Largest angle between the line of sight and the sheet's normal in calibration photos."""
ELEVATION_RANGE_DEG = (28.0, 68.0)
"""Elevation above the table of the cameras around the object."""


def make_sheet_cameras(layout: TagLayout, lens: Intrinsics, count: int, seed: int) -> Float[np.ndarray, "count 4 4"]:
    """Calibration poses, camera to world, meters: every photo shows all tags, in varying parts of the frame.

    Tilts of up to 45 degrees in all directions, any roll, distances from the minimum to a third farther.
    """
    rng = np.random.default_rng(seed)
    # With the white margin that detectors need.
    tags = np.concatenate([1.4 * layout.corners(tag) - 0.4 * layout.poses[tag][:3, 3] for tag in layout.poses])
    center = (tags.min(0) + tags.max(0)) / 2
    # The frame's center, corners and sides, the corners twice as often: there distortion is largest.
    goals = np.array([(0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1), (0, -1), (0, 1), (-1, -1), (1, 1), (1, -1), (-1, 1)])
    start, out = rng.random(2), []
    for i in range(count):
        tilt = np.radians(MAX_SHEET_ANGLE_DEG) * ((start[0] + i * GOLDEN_RATIO) % 1)
        azimuth, roll = 2 * np.pi * ((start[1] + i * GOLDEN_RATIO**2) % 1), rng.uniform(-np.pi, np.pi)
        spread = 1 + 0.3 * rng.random()
        direction = _direction(azimuth, np.pi / 2 - tilt)
        # The smallest distance at which all tags are in the frame, by bisection.
        near, far = 0.1 * layout.size, 1e3 * layout.size
        for _ in range(40):
            middle = np.sqrt(near * far)
            fits = is_in_frame(lens, _orbit_pose(center, middle * direction, roll), tags).all()
            near, far = (near, middle) if fits else (middle, far)
        c2w = _orbit_pose(center, spread * far * direction, roll)
        # As far toward the goal as keeps all tags in the frame.
        goal = (goals[i % len(goals)] + 1) / 2 * (lens.width, lens.height)
        middle_pixel = np.array([lens.cx, lens.cy])
        aimed = (_aim_camera(lens, c2w, center, (1 - s) * middle_pixel + s * goal) for s in np.linspace(1, 0, 41))
        out.append(next((pose for pose in aimed if is_in_frame(lens, pose, tags).all()), c2w))
    return np.array(out)


def make_object_cameras(
    layout: TagLayout, lens: Intrinsics, count: int, seed: int, steps: int | None = None
) -> Float[np.ndarray, "count 4 4"]:
    """Poses around the bulldozer, camera to world, meters, at varying heights and distances; `steps` (None: `count`) per turn.

    Every photo shows all of the bulldozer and two visible tags (one if there is only one).

    Raises:
        ValueError: hardly any position shows the object and two tags.
    """
    rng = np.random.default_rng(seed)
    top = Tabletop(layout)
    box = np.array(list(itertools.product(*top.box.T)))
    sheet = np.append(top.middle, 0.0)
    # Between the object and the sheet; above the sheet's center if the object stands there.
    center = (top.box.mean(0) + sheet) / 2
    radius = float(np.linalg.norm(box - center, axis=-1).max())
    start, out, min_tags = rng.random(), [], min(2, len(layout.poses))
    for i in range(count):
        near = 1.0
        for attempt in range(100):
            # From low elevations the object hides the tags behind it: try other heights and azimuths.
            turns = start + (i + rng.uniform(-0.3, 0.3)) / (steps or count) + 0.002 * attempt * rng.uniform(-1, 1)
            azimuth = 2 * np.pi * turns
            height = (start + i * GOLDEN_RATIO + (0.1 + 0.01 * attempt) * rng.uniform(-1, 1)) % 1
            elevation = np.radians(ELEVATION_RANGE_DEG[0] + (ELEVATION_RANGE_DEG[1] - ELEVATION_RANGE_DEG[0]) * height)
            distance = near * rng.uniform(1.0, 1.4) * radius * 2 * max(lens.fx, lens.fy) / min(lens.width, lens.height)
            c2w = _orbit_pose(center, distance * _direction(azimuth, elevation), np.radians(rng.normal(0, 6)))
            pixel = np.array([lens.cx, lens.cy]) + rng.uniform(-0.06, 0.06, 2) * (lens.width, lens.height)
            c2w = _aim_camera(lens, c2w, center, pixel)
            if is_in_frame(lens, c2w, box).all() and len(find_visible_tags(top, lens, c2w)) >= min_tags:
                break
            near *= 1.02  # a larger distance shows more
        else:
            raise ValueError("no view shows the object and two tags: the layout is too large")
        out.append(c2w)
    return np.array(out)


def is_in_frame(
    lens: Intrinsics, c2w: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "M 3"]
) -> Bool[np.ndarray, "M"]:
    """Mask of the points within a photo's frame, a margin inside its edges."""
    margin = MIN_MARGIN_FRACTION * lens.width
    local = apply_pose(invert_pose(c2w), points)
    # Beyond the frame's corners the distortion polynomial may fold back into the frame.
    corners = np.array(list(itertools.product((0.0, lens.width), (0.0, lens.height))))
    max_radius = np.linalg.norm(normalize_pixels(lens, corners), axis=-1).max()
    front = (local[:, 2] > 0) & (np.linalg.norm(local[:, :2], axis=-1) < max_radius * local[:, 2])
    out = np.zeros(len(points), bool)
    if front.any():
        pixels = project_points(lens, invert_pose(c2w), points[front])
        out[front] = ((pixels > margin) & (pixels < np.array([lens.width, lens.height]) - margin)).all(-1)
    return out


def find_visible_tags(top: Tabletop, lens: Intrinsics, c2w: Float[np.ndarray, "4 4"]) -> list[int]:
    """Tags that a photo of the object fully shows: in the frame, not under the object, not behind it."""
    corners = {tag: top.layout.corners(tag) for tag in sorted(top.free_tags)}
    in_frame = {tag: points for tag, points in corners.items() if is_in_frame(lens, c2w, points).all()}
    return [tag for tag, points in in_frame.items() if not top.is_occluded(c2w[:3, 3], points).any()]


def _direction(azimuth: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Unit vector from a subject toward its viewer."""
    ring = np.cos(elevation)
    return np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), np.sin(elevation)])


def _orbit_pose(
    center: Float[np.ndarray, "3"], offset: Float[np.ndarray, "3"], roll: float
) -> Float[np.ndarray, "4 4"]:
    """Camera at `center + offset` that looks at `center`, rolled about its optical axis."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    c2w = look_at(torch.from_numpy(center + offset), torch.from_numpy(center), up).numpy()
    return _rotate_camera(c2w, np.array([0.0, 0.0, roll]))


def _aim_camera(
    lens: Intrinsics, c2w: Float[np.ndarray, "4 4"], point: Float[np.ndarray, "3"], pixel: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "4 4"]:
    """Rotates a camera by the smallest angle so that it shows a point in the given pixel."""
    ray = np.append(normalize_pixels(lens, pixel[None])[0], 1.0)
    ray /= np.linalg.norm(ray)
    target = c2w[:3, :3].T @ (point - c2w[:3, 3])
    target /= np.linalg.norm(target)
    axis = np.cross(ray, target)
    sine = float(np.linalg.norm(axis))
    return c2w if sine < 1e-12 else _rotate_camera(c2w, axis / sine * np.arctan2(sine, float(ray @ target)))


def _rotate_camera(c2w: Float[np.ndarray, "4 4"], vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Rotates a camera by a rotation vector in the camera frame."""
    rotation = np.eye(4)
    rotation[:3, :3] = cv2.Rodrigues(vector)[0]
    return c2w @ rotation
