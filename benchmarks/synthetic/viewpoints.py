"""Where the cameras of a synthetic capture stand: all around a sheet of tags, and all around an object."""

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
"""Its multiples modulo 1 fill [0, 1] evenly, whatever their number."""
MIN_MARGIN_FRACTION = 0.02
"""Share of the frame's width that stays free between a tag and the frame's edge."""
MAX_SHEET_ANGLE_DEG = 45.0
"""Largest angle between the line of sight and the sheet's normal in calibration photos, degrees."""
ELEVATION_RANGE_DEG = (28.0, 68.0)
"""Of the cameras around the object, degrees above the table."""


def make_sheet_cameras(layout: TagLayout, lens: Intrinsics, count: int, seed: int) -> Float[np.ndarray, "count 4 4"]:
    """Poses for calibration, camera to world in metres: every photo shows all tags, each near another part of the frame.

    Tilts of up to 45 degrees toward all sides, any roll, distances from as near as possible to a third farther.
    """
    rng = np.random.default_rng(seed)
    # With the white rim that detectors need.
    tags = np.concatenate([1.4 * layout.corners(tag) - 0.4 * layout.poses[tag][:3, 3] for tag in layout.poses])
    centre = (tags.min(0) + tags.max(0)) / 2
    # The frame's middle, corners and sides, the corners twice as often: there the distortion shows.
    goals = np.array([(0, 0), (-1, -1), (1, 1), (1, -1), (-1, 1), (0, -1), (0, 1), (-1, -1), (1, 1), (1, -1), (-1, 1)])
    start, out = rng.random(2), []
    for i in range(count):
        tilt = np.radians(MAX_SHEET_ANGLE_DEG) * ((start[0] + i * GOLDEN_RATIO) % 1)
        turn, roll = 2 * np.pi * ((start[1] + i * GOLDEN_RATIO**2) % 1), rng.uniform(-np.pi, np.pi)
        spread = 1 + 0.3 * rng.random()
        direction = _direction(turn, np.pi / 2 - tilt)
        # The nearest distance at which all tags are in the frame, by bisection.
        near, far = 0.1 * layout.size, 1e3 * layout.size
        for _ in range(40):
            middle = np.sqrt(near * far)
            fits = is_in_frame(lens, _orbit_pose(centre, middle * direction, roll), tags).all()
            near, far = (near, middle) if fits else (middle, far)
        c2w = _orbit_pose(centre, spread * far * direction, roll)
        # As far toward the goal as all tags stay in the frame.
        goal = (goals[i % len(goals)] + 1) / 2 * (lens.width, lens.height)
        middle_pixel = np.array([lens.cx, lens.cy])
        aimed = (_aim_camera(lens, c2w, centre, (1 - s) * middle_pixel + s * goal) for s in np.linspace(1, 0, 41))
        out.append(next((pose for pose in aimed if is_in_frame(lens, pose, tags).all()), c2w))
    return np.array(out)


def make_object_cameras(
    layout: TagLayout, lens: Intrinsics, count: int, seed: int, steps: int | None = None
) -> Float[np.ndarray, "count 4 4"]:
    """Poses around the bulldozer, camera to world in metres, at changing heights and distances.

    A full turn takes `steps` of them; None: `count`.

    Every photo shows all of the bulldozer, and two tags that it does not hide (one if there is only one).

    Raises:
        ValueError: hardly any place shows the object and two tags.
    """
    rng = np.random.default_rng(seed)
    top = Tabletop(layout)
    box = np.array(list(itertools.product(*top.box.T)))
    sheet = np.append(top.middle, 0.0)
    # Between the object and the sheet; above the sheet's middle where the object stands there.
    centre = (top.box.mean(0) + sheet) / 2
    reach = float(np.linalg.norm(box - centre, axis=-1).max())
    start, out = rng.random(), []
    for i in range(count):
        near = 1.0
        for attempt in range(100):
            # From low down the object hides what is behind it: try other heights, and places farther along.
            turn = (
                2
                * np.pi
                * (start + (i + rng.uniform(-0.3, 0.3)) / (steps or count) + 0.002 * attempt * rng.uniform(-1, 1))
            )
            height = (start + i * GOLDEN_RATIO + (0.1 + 0.01 * attempt) * rng.uniform(-1, 1)) % 1
            elevation = np.radians(ELEVATION_RANGE_DEG[0] + (ELEVATION_RANGE_DEG[1] - ELEVATION_RANGE_DEG[0]) * height)
            distance = near * rng.uniform(1.0, 1.4) * reach * 2 * max(lens.fx, lens.fy) / min(lens.width, lens.height)
            c2w = _orbit_pose(centre, distance * _direction(turn, elevation), np.radians(rng.normal(0, 6)))
            place = np.array([lens.cx, lens.cy]) + rng.uniform(-0.06, 0.06, 2) * (lens.width, lens.height)
            c2w = _aim_camera(lens, c2w, centre, place)
            if is_in_frame(lens, c2w, box).all() and len(find_visible_tags(top, lens, c2w)) >= min(
                2, len(layout.poses)
            ):
                break
            near *= 1.02  # from further away more is in the frame
        else:
            raise ValueError("no view shows the object and two tags: they lie too far apart")
        out.append(c2w)
    return np.array(out)


def is_in_frame(
    lens: Intrinsics, c2w: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "M 3"]
) -> Bool[np.ndarray, "M"]:
    """Which points lie within a photo's frame, a little inside its edges."""
    rim = MIN_MARGIN_FRACTION * lens.width
    local = apply_pose(invert_pose(c2w), points)
    # Beyond the frame's corners the distortion's polynomial may turn back: what seems to be in the frame is not.
    corners = np.array(list(itertools.product((0.0, lens.width), (0.0, lens.height))))
    widest = np.linalg.norm(normalize_pixels(lens, corners), axis=-1).max()
    front = (local[:, 2] > 0) & (np.linalg.norm(local[:, :2], axis=-1) < widest * local[:, 2])
    out = np.zeros(len(points), bool)
    if front.any():
        pixels = project_points(lens, invert_pose(c2w), points[front])
        out[front] = ((pixels > rim) & (pixels < np.array([lens.width, lens.height]) - rim)).all(-1)
    return out


def find_visible_tags(top: Tabletop, lens: Intrinsics, c2w: Float[np.ndarray, "4 4"]) -> list[int]:
    """The tags that a photo of the object shows whole: in the frame, not under the object, not behind it."""
    corners = {tag: top.layout.corners(tag) for tag in sorted(top.free_tags)}
    return [
        t for t, c in corners.items() if is_in_frame(lens, c2w, c).all() and not top.is_occluded(c2w[:3, 3], c).any()
    ]


def _direction(turn: float, elevation: float) -> Float[np.ndarray, "3"]:
    """Unit vector from a subject toward its viewer."""
    ring = np.cos(elevation)
    return np.array([ring * np.cos(turn), ring * np.sin(turn), np.sin(elevation)])


def _orbit_pose(
    centre: Float[np.ndarray, "3"], offset: Float[np.ndarray, "3"], roll: float
) -> Float[np.ndarray, "4 4"]:
    """A camera at `centre + offset` that looks at `centre`, turned about its own axis."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    c2w = look_at(torch.from_numpy(centre + offset), torch.from_numpy(centre), up).numpy()
    return _rotate_camera(c2w, np.array([0.0, 0.0, roll]))


def _aim_camera(
    lens: Intrinsics, c2w: Float[np.ndarray, "4 4"], point: Float[np.ndarray, "3"], pixel: Float[np.ndarray, "2"]
) -> Float[np.ndarray, "4 4"]:
    """The camera turned on its spot, by the shortest way, so that it shows a point it looked at in the given pixel."""
    ray = np.append(normalize_pixels(lens, pixel[None])[0], 1.0)
    ray /= np.linalg.norm(ray)
    target = c2w[:3, :3].T @ (point - c2w[:3, 3])
    target /= np.linalg.norm(target)
    axis = np.cross(ray, target)
    sine = float(np.linalg.norm(axis))
    return c2w if sine < 1e-12 else _rotate_camera(c2w, axis / sine * np.arctan2(sine, float(ray @ target)))


def _rotate_camera(c2w: Float[np.ndarray, "4 4"], vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """A camera turned about itself by a rotation vector of its own frame."""
    turn = np.eye(4)
    turn[:3, :3] = cv2.Rodrigues(vector)[0]
    return c2w @ turn
