"""Solids: boxes and cylinders with their materials, the parts a built-in model is made of."""

import itertools
import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

PLAIN, CHEQUER, STRIPES, BRICKWORK = range(4)

STUD_PITCH = 0.1
STUD_RADIUS = 0.03
STUD_HEIGHT = 0.025
BRICK_HEIGHT = 0.12


class Material(NamedTuple):
    """How a surface looks. Colours are linear, in [0, 1]."""

    colour: tuple[float, float, float]
    accent: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The pattern's second colour."""
    pattern: int = PLAIN
    period: float = 0.1
    """The pattern's width in world units."""
    gloss: float = 0.35
    """Strength of the highlight."""


@dataclass(frozen=True)
class Solids:
    """P convex solids as arrays: a unit cube or a unit cylinder (axis z), scaled, turned and moved into the world."""

    cylinder: Bool[np.ndarray, "P"]
    """A cylinder where true, a box elsewhere."""
    centre: Float[np.ndarray, "P 3"]
    axes: Float[np.ndarray, "P 3 3"]
    """Rows are the solid's own axes in the world frame."""
    half: Float[np.ndarray, "P 3"]
    """Half-sizes along the axes; a cylinder's are (radius, radius, half its length)."""
    colour: Float[np.ndarray, "P 3"]
    accent: Float[np.ndarray, "P 3"]
    pattern: Int[np.ndarray, "P"]
    period: Float[np.ndarray, "P"]
    gloss: Float[np.ndarray, "P"]

    def __len__(self) -> int:
        return self.centre.shape[0]

    @property
    def to_unit(self) -> Float[np.ndarray, "P 3 3"]:
        """Maps world offsets from the centre into the frame where the solid is the unit cube or the unit cylinder."""
        return self.axes / self.half[:, :, None]

    @property
    def corners(self) -> Float[np.ndarray, "P 8 3"]:
        """Corners of each solid's own bounding box, world frame."""
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
        return self.centre[:, None] + (signs[None] * self.half[:, None]) @ self.axes

    @property
    def aabb(self) -> Float[np.ndarray, "2 3"]:
        """The exact axis-aligned box around all solids, world units."""
        reach = self.half[:, :, None] * self.axes
        box = np.abs(reach).sum(1)
        # A disc reaches radius * sin(angle to its axis), less than the square around it does.
        disc = np.hypot(reach[:, 0], reach[:, 1]) + np.abs(reach[:, 2])
        extent = np.where(self.cylinder[:, None], disc, box)
        return np.stack([(self.centre - extent).min(0), (self.centre + extent).max(0)])


@dataclass
class Builder:
    """Collects solids one by one; `build` makes them arrays. Positions and lengths in world units."""

    parts: list[tuple] = field(default_factory=list)

    def box(self, corner: tuple, opposite: tuple, material: Material) -> None:
        """An axis-aligned box between two opposite corners."""
        a, b = np.array(corner, float), np.array(opposite, float)
        self.parts.append((False, (a + b) / 2, np.eye(3), np.abs(b - a) / 2, material))

    def bar(self, start: tuple, end: tuple, width: float, thickness: float, material: Material) -> None:
        """A straight bar between two points in a plane of constant x; `width` is its size along x."""
        a, b = np.array(start, float), np.array(end, float)
        length = np.linalg.norm(b - a)
        along = (b - a) / length
        across = np.array([1.0, 0.0, 0.0])
        axes = np.stack([across, along, np.cross(across, along)])
        self.parts.append((False, (a + b) / 2, axes, np.array([width, length, thickness]) / 2, material))

    def cylinder(self, start: tuple, end: tuple, radius: float, material: Material) -> None:
        """A cylinder between the centres of its two caps."""
        a, b = np.array(start, float), np.array(end, float)
        length = np.linalg.norm(b - a)
        along = (b - a) / length
        side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        side /= np.linalg.norm(side)
        axes = np.stack([side, np.cross(along, side), along])
        self.parts.append((True, (a + b) / 2, axes, np.array([radius, radius, length / 2]), material))

    def studs(self, low: tuple[float, float], high: tuple[float, float], z: float, material: Material) -> None:
        """As many rows of studs as fit on the rectangle at height `z`, centred on it."""
        counts = [math.floor(abs(b - a) / STUD_PITCH + 1e-6) for a, b in zip(low, high, strict=True)]
        xs, ys = (
            [(a + b) / 2 + (i - (count - 1) / 2) * STUD_PITCH for i in range(count)]
            for a, b, count in zip(low, high, counts, strict=True)
        )
        for x, y in itertools.product(xs, ys):
            self.cylinder((x, y, z), (x, y, z + STUD_HEIGHT), STUD_RADIUS, material)

    def build(self, scale: float = 1.0, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Solids:
        """All solids, first moved by `shift`, then scaled about the origin, their patterns with them."""
        cylinder, centre, axes, half, materials = zip(*self.parts, strict=True)
        colour, accent, pattern, period, gloss = zip(*materials, strict=True)
        return Solids(
            cylinder=np.array(cylinder),
            centre=scale * (np.array(centre) + shift),
            axes=np.array(axes),
            half=scale * np.array(half),
            colour=np.array(colour, np.float32),
            accent=np.array(accent, np.float32),
            pattern=np.array(pattern),
            period=scale * np.array(period, np.float32),
            gloss=np.array(gloss, np.float32),
        )
