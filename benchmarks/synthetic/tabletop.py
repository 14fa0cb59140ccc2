"""What synthetic photos show: a printed sheet of tags on a round table, and the built-in bulldozer standing there."""

import cv2
import numba
import numpy as np
from jaxtyping import Bool, Float, Int

from nerf_lightning.capture.tags.detect import get_dictionary
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.kernels.cpu.solids import add_colour, dot, entry_distance, is_lit, subtract, transform
from nerf_lightning.synthetic.solids import Solids, load_bulldozer
from nerf_lightning.synthetic.tracer import render_shadow_map

INK, PAPER, WALL = 0.09, 0.90, 0.75
"""Shades of grey in sRGB."""
WOOD, GRAIN = np.array([0.56, 0.44, 0.33]), np.array([0.10, 0.10, 0.09])
"""sRGB of the table, and the amplitude of its texture."""
TABLE_MARGIN_M = 0.3
"""Metres of table all around the paper."""
OBJECT_LENGTH_M = 0.12
"""Of the bulldozer along the world's y axis, metres."""
SHADOW_BRIGHTNESS = 0.65
"""Share of its sRGB colour that the ground keeps in the bulldozer's shadow."""


class Tabletop:
    """The world z >= 0, in metres: z up, tags in the plane z = 0. Beyond the table's edge there is a grey wall, at infinity.

    The bulldozer stands in the middle of the tags, or beside the paper if it would stand on more than half of them. `hidden`:
    another sheet, blank, lies on the tags.
    """

    def __init__(self, layout: TagLayout, hidden: bool = False):
        if not all(np.allclose(pose[2], [0, 0, 1, 0]) for pose in layout.poses.values()):
            raise ValueError("tags must lie face up in the plane z = 0")
        self.layout = layout
        corners = {tag: layout.corners(tag)[:, :2] for tag in layout.poses}
        every = np.concatenate(list(corners.values()))
        patterns = get_dictionary(layout.dictionary)
        # Twice the white rim of one module that detectors ask for, in the family with the largest modules.
        margin = layout.size / 3
        self.paper: Float[np.ndarray, "2 2"] = np.stack([every.min(0) - margin, every.max(0) + margin])
        self.middle: Float[np.ndarray, "2"] = self.paper.mean(0)
        self.radius = float(np.linalg.norm(self.paper[1] - self.middle)) + TABLE_MARGIN_M
        side = patterns.markerSize + 2
        self._modules = {
            tag: cv2.aruco.generateImageMarker(patterns, tag, side) > 127 for tag in layout.poses if not hidden
        }

        low, high = load_bulldozer().aabb
        self.scale = OBJECT_LENGTH_M / (high[1] - low[1])
        """Metres a unit of the bulldozer's own frame, which is moved but not turned."""
        size = self.scale * (high - low)
        spot = self.middle
        low_spot, high_spot = spot - size[:2] / 2, spot + size[:2] / 2
        free = {t for t, c in corners.items() if ((c.min(0) > high_spot) | (c.max(0) < low_spot)).any()}
        if 2 * len(free) < len(corners):
            spot = np.array([self.middle[0], self.paper[1, 1] + 0.6 * OBJECT_LENGTH_M])
            free = set(corners)
        self.free_tags: frozenset[int] = frozenset(free)
        """Those that the bulldozer does not stand on."""
        self.box: Float[np.ndarray, "2 3"] = np.array([[*(spot - size[:2] / 2), 0], [*(spot + size[:2] / 2), size[2]]])
        """Lower and upper corner around the bulldozer, world frame."""
        self.shift = self.box[0] - self.scale * low
        """World = scale * own frame + shift."""

    def colours(
        self, eye: Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"], with_object: bool
    ) -> Float[np.ndarray, "N 3"]:
        """sRGB in [0, 1] that rays with these unit directions see, from a point above the table; world frame."""
        with np.errstate(divide="ignore"):
            t = np.where(directions[:, 2] < 0, -eye[2] / directions[:, 2], np.inf)
        down = np.flatnonzero(np.isfinite(t))
        points = eye[:2] + t[down, None] * directions[down, :2]
        near = ((points - self.middle) ** 2).sum(-1) < self.radius**2
        table, points = down[near], points[near]
        out = np.full((len(directions), 3), WALL)
        out[table] = self.ground(points)
        if with_object:
            out[table] *= np.where(self._is_shaded(points), SHADOW_BRIGHTNESS, 1)[:, None]
            self._add_object(out, eye, directions, t)
        return out

    def ground(self, points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
        """sRGB of points (x, y) of the plane z = 0."""
        out = _wood_colour(points)
        out[((points > self.paper[0]) & (points < self.paper[1])).all(-1)] = PAPER
        low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(2), np.zeros(2))
        for tag, modules in self._modules.items():
            pose, side = self.layout.poses[tag], len(modules)
            reach = self.layout.size * np.sqrt(0.5)
            if (pose[:2, 3] + reach < low).any() or (pose[:2, 3] - reach > high).any():
                continue
            # In the tag's own frame x is the printed right and y the printed top, so that rows count downward.
            own = (points - pose[:2, 3]) @ pose[:2, :2] / self.layout.size
            col, row = np.floor((0.5 + own[:, 0]) * side), np.floor((0.5 - own[:, 1]) * side)
            inside = np.flatnonzero((col >= 0) & (col < side) & (row >= 0) & (row < side))
            white = modules[row[inside].astype(int), col[inside].astype(int)]
            out[inside] = np.where(white, PAPER, INK)[:, None]
        return out

    def _is_shaded(self, points: Float[np.ndarray, "N 2"]) -> Bool[np.ndarray, "N"]:
        """Whether points of the plane z = 0 lie in the bulldozer's shadow."""
        out = np.zeros(len(points), bool)
        # The lamp stands 56 degrees high: no shadow is longer than the bulldozer.
        near = np.flatnonzero(
            ((points > self.box[0, :2] - OBJECT_LENGTH_M) & (points < self.box[1, :2] + OBJECT_LENGTH_M)).all(-1)
        )
        own = (np.pad(points[near], ((0, 0), (0, 1))) - self.shift) / self.scale
        out[near] = ~find_lit_points(render_shadow_map(), own)
        return out

    def _add_object(
        self,
        out: Float[np.ndarray, "N 3"],
        eye: Float[np.ndarray, "3"],
        directions: Float[np.ndarray, "N 3"],
        t: Float[np.ndarray, "N"],
    ) -> None:
        """Paints the bulldozer over whatever is farther away; `t` is the distance of that."""
        origin = (eye - self.shift) / self.scale
        some = _cull_to_cone(load_bulldozer(), origin, directions)
        part = Solids(*(values[some] for values in load_bulldozer()))
        solid, distance = find_nearest(part, np.broadcast_to(origin, directions.shape), directions)
        hit = np.flatnonzero(self.scale * distance < t)
        out[hit] = shade_points(some[solid[hit]], origin + distance[hit, None] * directions[hit], directions[hit])

    def is_occluded(self, eye: Float[np.ndarray, "3"], points: Float[np.ndarray, "M 3"]) -> Bool[np.ndarray, "M"]:
        """Whether the box around the bulldozer lies between a viewer and points."""
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = (self.box[:, None] - eye) / (points - eye)
        return np.maximum(sides.min(0).max(-1), 0) < np.minimum(sides.max(0).min(-1), 1)


def _wood_colour(points: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """A smooth grain along x. No wave is shorter than 2 cm, so that pixels of a few millimetres see no aliasing."""
    x, y = points.T
    bent = y + 0.018 * np.sin(17 * x + 9 * y) + 0.007 * np.sin(43 * x - 31 * y)
    wave = 0.5 * np.sin(150 * bent) + 0.3 * np.sin(89 * bent + 7 * x + 1) + 0.2 * np.sin(60 * x + 70 * y + 2)
    return WOOD + wave[:, None] * GRAIN


def _cull_to_cone(
    solids: Solids, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "N 3"]
) -> Int[np.ndarray, "P"]:
    """Indices of the solids that some rays may hit: those whose bounding sphere reaches into the cone around the rays."""
    axis = directions.mean(0)
    axis /= np.linalg.norm(axis)
    opening = np.arccos(np.clip((directions @ axis).min(), -1, 1))
    offset = solids.centre - origin
    distance = np.linalg.norm(offset, axis=-1)
    spheres = np.arcsin(np.clip(np.linalg.norm(solids.half_size, axis=-1) / distance, 0, 1))
    away = np.arccos(np.clip(offset @ axis / distance, -1, 1))
    return np.flatnonzero(away <= opening + spheres + 1e-6)


def find_nearest(
    solids: Solids, origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"]
) -> tuple[Int[np.ndarray, "R"], Float[np.ndarray, "R"]]:
    """The first solid each ray enters from outside (-1 for none), and where, in lengths of `directions` (inf for none)."""
    solid, t = np.full(len(origins), -1), np.full(len(origins), np.inf)
    _find_nearest(solids, solids.to_unit, np.array(origins, float), np.array(directions, float), solid, t)
    return solid, t


def shade_points(
    solid: Int[np.ndarray, "N"], points: Float[np.ndarray, "N 3"], directions: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 3"]:
    """sRGB in [0, 1] of points on the bulldozer's solids, seen along unit directions; its own frame."""
    rgb = np.zeros((len(points), 3))
    _shade_points(load_bulldozer().to_float32(), render_shadow_map(), solid, points, directions, rgb)
    return rgb


compiled = numba.njit(cache=True, nogil=True, error_model="numpy")


@compiled
def _find_nearest(solids, to_unit, origins, directions, solid, t):
    for ray in range(len(t)):
        d = directions[ray]
        for k in range(len(solids.centre)):
            offset, half = subtract(origins[ray], solids.centre[k]), solids.half_size[k]
            # Whether the ray meets the sphere around the solid.
            if dot(offset, offset) - dot(offset, d) ** 2 / dot(d, d) < 1.0001 * dot(half, half):
                distance = entry_distance(
                    solids.is_cylinder[k], transform(to_unit[k], offset), transform(to_unit[k], d)
                )
                if distance < t[ray]:
                    solid[ray], t[ray] = k, distance


@compiled
def _shade_points(solids, shadow, solid, points, directions, rgb):
    for n in range(len(points)):
        add_colour(solids, shadow, solid[n], points[n], directions[n], rgb[n])


@compiled
def find_lit_points(shadow, points):
    """Which points [N, 3] that are on no solid the key light reaches."""
    return np.array([is_lit(shadow, -1, points[n]) for n in range(len(points))])
