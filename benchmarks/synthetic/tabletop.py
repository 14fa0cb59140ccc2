"""The tabletop of synthetic photos: a printed sheet of tags on a round table, and the bulldozer."""

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from nerf_lightning.capture.tags.detect import get_dictionary
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.kernels.cpu.solids import add_color, dot, entry_distance, is_unshadowed, subtract, transform
from nerf_lightning.synthetic.solids import Solids, load_bulldozer
from nerf_lightning.synthetic.tracer import render_shadow_map

INK, PAPER, WALL = 0.09, 0.90, 0.75
"""Gray levels, sRGB."""
WOOD, GRAIN = np.array([0.56, 0.44, 0.33]), np.array([0.10, 0.10, 0.09])
"""Color of the table, sRGB, and the amplitude of its texture."""
TABLE_MARGIN_M = 0.3
"""Width of the table around the paper."""
OBJECT_LENGTH_M = 0.12
"""Length of the bulldozer along the world's y axis."""
SHADOW_BRIGHTNESS = 0.65
"""Factor of the ground's sRGB color in the bulldozer's shadow."""


class Tabletop:
    """A table in the plane z = 0, z up, meters, with tags lying on it; beyond its edge there is a gray wall at infinity.

    The bulldozer stands at the center of the tags, or next to the paper if it would cover more than half of them. `hidden`:
    a blank sheet covers the tags.
    """

    def __init__(self, layout: TagLayout, hidden: bool = False):
        if not all(np.allclose(pose[2], [0, 0, 1, 0]) for pose in layout.poses.values()):
            raise ValueError("tags must lie face up in the plane z = 0")
        self.layout = layout
        corners = {tag: layout.corners(tag)[:, :2] for tag in layout.poses}
        all_corners = np.concatenate(list(corners.values()))
        patterns = get_dictionary(layout.dictionary)
        # Twice the white margin of one module that detectors need, in the family with the largest modules.
        margin = layout.size / 3
        self.paper: Float[np.ndarray, "2 2"] = np.stack([all_corners.min(0) - margin, all_corners.max(0) + margin])
        self.middle: Float[np.ndarray, "2"] = self.paper.mean(0)
        self.radius = float(np.linalg.norm(self.paper[1] - self.middle)) + TABLE_MARGIN_M
        side = patterns.markerSize + 2
        tags = () if hidden else layout.poses
        self._modules = {tag: cv2.aruco.generateImageMarker(patterns, tag, side) > 127 for tag in tags}

        low, high = load_bulldozer().aabb
        self.scale = OBJECT_LENGTH_M / (high[1] - low[1])
        """Meters per unit of the bulldozer's frame, which is translated but not rotated."""
        size = self.scale * (high - low)
        spot = self.middle
        low_spot, high_spot = spot - size[:2] / 2, spot + size[:2] / 2
        free = {t for t, c in corners.items() if ((c.min(0) > high_spot) | (c.max(0) < low_spot)).any()}
        if 2 * len(free) < len(corners):
            spot = np.array([self.middle[0], self.paper[1, 1] + 0.6 * OBJECT_LENGTH_M])
            free = set(corners)
        self.free_tags: frozenset[int] = frozenset(free)
        """Tags that the bulldozer does not cover."""
        self.box: Float[np.ndarray, "2 3"] = np.array([[*(spot - size[:2] / 2), 0], [*(spot + size[:2] / 2), size[2]]])
        """Bounding box of the bulldozer, world frame."""
        self.shift = self.box[0] - self.scale * low
        """World = scale * bulldozer frame + shift."""

    def colors(
        self, eye: Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"], with_object: bool
    ) -> Float[np.ndarray, "N 3"]:
        """Traces rays from a point above the table, world frame, unit directions; returns sRGB in [0, 1]."""
        with np.errstate(divide="ignore"):
            t = np.where(directions[:, 2] < 0, -eye[2] / directions[:, 2], np.inf)
        down = np.flatnonzero(np.isfinite(t))
        points = eye[:2] + t[down, None] * directions[down, :2]
        on_table = ((points - self.middle) ** 2).sum(-1) < self.radius**2
        table, points = down[on_table], points[on_table]
        out = np.full((len(directions), 3), WALL)
        out[table] = self.ground(points)
        if with_object:
            out[table] *= np.where(self._is_shaded(points), SHADOW_BRIGHTNESS, 1)[:, None]
            self._add_object(out, eye, directions, t)
        return out

    def ground(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """sRGB of points (x, y) in the plane z = 0."""
        out = _wood_color(points)
        out[((points > self.paper[0]) & (points < self.paper[1])).all(-1)] = PAPER
        low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(2), np.zeros(2))
        for tag, modules in self._modules.items():
            pose, side = self.layout.poses[tag], len(modules)
            radius = self.layout.size * np.sqrt(0.5)
            if (pose[:2, 3] + radius < low).any() or (pose[:2, 3] - radius > high).any():
                continue
            # In the tag's frame x is the printed right and y the printed top; rows count downward.
            local = (points - pose[:2, 3]) @ pose[:2, :2] / self.layout.size
            col, row = np.floor((0.5 + local[:, 0]) * side), np.floor((0.5 - local[:, 1]) * side)
            inside = np.flatnonzero((col >= 0) & (col < side) & (row >= 0) & (row < side))
            white = modules[row[inside].astype(int), col[inside].astype(int)]
            out[inside] = np.where(white, PAPER, INK)[:, None]
        return out

    def _is_shaded(self, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, "N"]:
        """Mask of the points in the plane z = 0 that lie in the bulldozer's shadow."""
        out = np.zeros(len(points), bool)
        # The light is 56 degrees high: no shadow is longer than the bulldozer.
        low, high = self.box[0, :2] - OBJECT_LENGTH_M, self.box[1, :2] + OBJECT_LENGTH_M
        near = np.flatnonzero(((points > low) & (points < high)).all(-1))
        local = (np.pad(points[near], ((0, 0), (0, 1))) - self.shift) / self.scale
        out[near] = ~find_unshadowed_points(render_shadow_map(), local)
        return out

    def _add_object(
        self,
        out: Float[np.ndarray, "N 3"],
        eye: Float[np.ndarray, "3"],
        directions: Float[np.ndarray, "N 3"],
        t: Float[np.ndarray, "N"],
    ) -> None:
        """Draws the bulldozer over rays whose distance `t` is larger."""
        origin = (eye - self.shift) / self.scale
        indices = _cull_to_cone(load_bulldozer(), origin, directions)
        visible = Solids(*(values[indices] for values in load_bulldozer()))
        solid, distance = find_nearest(visible, np.broadcast_to(origin, directions.shape), directions)
        hit = np.flatnonzero(self.scale * distance < t)
        out[hit] = shade_points(indices[solid[hit]], origin + distance[hit, None] * directions[hit], directions[hit])

    def is_occluded(self, eye: Float[np.ndarray, "3"], points: Float[np.ndarray, "M 3"]) -> Bool[np.ndarray, "M"]:
        """Mask of the points that the bulldozer's bounding box hides from a viewer."""
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (self.box[:, None] - eye) / (points - eye)
        return np.maximum(sides.min(0).max(-1), 0) < np.minimum(sides.max(0).min(-1), 1)


def _wood_color(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Smooth grain along x, with no wave shorter than 2 cm, so that pixels of a few millimeters do not alias."""
    x, y = points.T
    warped_y = y + 0.018 * np.sin(17 * x + 9 * y) + 0.007 * np.sin(43 * x - 31 * y)
    wave = 0.5 * np.sin(150 * warped_y) + 0.3 * np.sin(89 * warped_y + 7 * x + 1) + 0.2 * np.sin(60 * x + 70 * y + 2)
    return WOOD + wave[:, None] * GRAIN


def _cull_to_cone(
    solids: Solids, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]
) -> Int[np.ndarray, "P"]:
    """Indices of the solids whose bounding sphere intersects the cone around some rays."""
    axis = directions.mean(0)
    axis /= np.linalg.norm(axis)
    half_angle = np.arccos(np.clip((directions @ axis).min(), -1, 1))
    offset = solids.center - origin
    distance = np.linalg.norm(offset, axis=-1)
    angular_radius = np.arcsin(np.clip(np.linalg.norm(solids.half_size, axis=-1) / distance, 0, 1))
    axis_angle = np.arccos(np.clip(offset @ axis / distance, -1, 1))
    return np.flatnonzero(axis_angle <= half_angle + angular_radius + 1e-6)


def find_nearest(
    solids: Solids, origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"]
) -> tuple[Int[np.ndarray, "R"], Float[np.ndarray, "R"]]:
    """First solid that each ray enters from outside (-1 for none), and its t in units of `directions` (inf for none)."""
    solid, t = np.full(len(origins), -1), np.full(len(origins), np.inf)
    _find_nearest(solids, solids.to_unit, np.array(origins, float), np.array(directions, float), solid, t)
    return solid, t


def shade_points(
    solid: Int[np.ndarray, "N"], points: Float[np.ndarray, "N 3"], directions: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 3"]:
    """sRGB in [0, 1] of points on the bulldozer's solids, viewed along unit directions; bulldozer frame."""
    rgb = np.zeros((len(points), 3))
    _shade_points(load_bulldozer().to_float32(), render_shadow_map(), solid, points, directions, rgb)
    return rgb


compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@compiled
def _find_nearest(solids, to_unit, origins, directions, solid, t):
    for ray in range(len(t)):
        d = directions[ray]
        for k in range(len(solids.center)):
            offset, half = subtract(origins[ray], solids.center[k]), solids.half_size[k]
            # Only if the ray intersects the bounding sphere.
            if dot(offset, offset) - dot(offset, d) ** 2 / dot(d, d) < 1.0001 * dot(half, half):
                matrix = to_unit[k]
                distance = entry_distance(solids.is_cylinder[k], transform(matrix, offset), transform(matrix, d))
                if distance < t[ray]:
                    solid[ray], t[ray] = k, distance


@compiled
def _shade_points(solids, shadow, solid, points, directions, rgb):
    for n in range(len(points)):
        add_color(solids, shadow, solid[n], points[n], directions[n], rgb[n])


@compiled
def find_unshadowed_points(shadow, points):
    """Mask of the points [N, 3], on no solid, that the key light reaches."""
    return np.array([is_unshadowed(shadow, -1, points[n]) for n in range(len(points))])
