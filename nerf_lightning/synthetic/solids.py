"""Solids: boxes and cylinders with their materials, and the model made of them."""

import functools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

PATTERNS = ("plain", "chequer", "stripes", "brickwork")
IDENTITY_AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


class Solids(NamedTuple):
    """P convex solids as arrays: a unit cube or a unit cylinder (axis z), scaled, turned and moved into the world."""

    is_cylinder: Bool[np.ndarray, "P"]
    """A cylinder where true, a box elsewhere."""
    centre: Float[np.ndarray, "P 3"]
    half_size: Float[np.ndarray, "P 3"]
    """Half-sizes along the axes; a cylinder's are (radius, radius, half its length)."""
    axes: Float[np.ndarray, "P 3 3"]
    """Rows are the solid's own axes in the world frame."""
    colour: Float[np.ndarray, "P 3"]
    """Linear, in [0, 1]."""
    accent: Float[np.ndarray, "P 3"]
    """The pattern's second colour."""
    pattern: Int[np.ndarray, "P"]
    """Index in `PATTERNS`."""
    period: Float[np.ndarray, "P"]
    """The pattern's width in world units."""
    gloss: Float[np.ndarray, "P"]
    """Strength of the highlight."""

    @property
    def to_unit(self) -> Float[np.ndarray, "P 3 3"]:
        """Maps world offsets from the centre into the frame where the solid is the unit cube or the unit cylinder."""
        return self.axes / self.half_size[:, :, None]

    @property
    def aabb(self) -> Float[np.ndarray, "2 3"]:
        """The exact axis-aligned box around all solids, world units."""
        reach = self.half_size[:, :, None] * self.axes
        box = np.abs(reach).sum(1)
        # A disc reaches radius * sin(angle to its axis), less than the square around it does.
        disc = np.hypot(reach[:, 0], reach[:, 1]) + np.abs(reach[:, 2])
        extent = np.where(self.is_cylinder[:, None], disc, box)
        return np.stack([(self.centre - extent).min(0), (self.centre + extent).max(0)])

    def to_float32(self) -> "Solids":
        """The same with its geometry in single precision."""
        return self._replace(
            **{name: getattr(self, name).astype(np.float32) for name in ("centre", "half_size", "axes")}
        )


@functools.cache
def load_bulldozer() -> Solids:
    """The bulldozer of the built-in scene. Front is +y, up is +z; 1.3 x 2.2 x 1.5 world units."""
    model = json.loads(Path(__file__).with_name("bulldozer.json").read_text(encoding="utf-8"))
    kinds, names, *geometry = zip(*((*row, IDENTITY_AXES)[:5] for row in model["solids"]), strict=True)
    materials = [model["materials"][name] for name in names]
    looks = {
        key: np.array([one[key] for one in materials], np.float32) for key in ("colour", "accent", "period", "gloss")
    }
    pattern = np.array([PATTERNS.index(one["pattern"]) for one in materials])
    centre, half, axes = (np.array(part, float) for part in geometry)
    return Solids(np.array(kinds) == "cylinder", centre, half, axes, pattern=pattern, **looks)
