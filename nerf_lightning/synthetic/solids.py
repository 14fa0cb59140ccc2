"""Solids: boxes and cylinders with materials, and the bulldozer made of them."""

import functools
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

PATTERNS = ("plain", "checker", "stripes", "brickwork")
IDENTITY_AXES = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]


class Solids(NamedTuple):
    """P solids as arrays: unit cubes or unit cylinders (axis z), scaled, rotated and translated into the world."""

    is_cylinder: Bool[np.ndarray, "P"]
    center: Float[np.ndarray, "P 3"]
    half_size: Float[np.ndarray, "P 3"]
    """Along the solid's axes; (radius, radius, half length) of a cylinder."""
    axes: Float[np.ndarray, "P 3 3"]
    """Rows are the solid's axes in the world frame."""
    color: Float[np.ndarray, "P 3"]
    """Linear RGB, in [0, 1]."""
    accent: Float[np.ndarray, "P 3"]
    """Second color of the pattern."""
    pattern: Int[np.ndarray, "P"]
    """Index in `PATTERNS`."""
    period: Float[np.ndarray, "P"]
    """Width of the pattern, world units."""
    gloss: Float[np.ndarray, "P"]
    """Strength of the specular highlight."""

    @property
    def to_unit(self) -> Float[np.ndarray, "P 3 3"]:
        """Maps world offsets from the center to the frame of the unit cube or cylinder."""
        return self.axes / self.half_size[:, :, None]

    @property
    def aabb(self) -> Float[np.ndarray, "2 3"]:
        """Exact axis-aligned bounding box of all solids, world units."""
        reach = self.half_size[:, :, None] * self.axes
        box = np.abs(reach).sum(1)
        # A disc extends radius * sin(angle to its axis), less than its bounding square.
        disc = np.hypot(reach[:, 0], reach[:, 1]) + np.abs(reach[:, 2])
        extent = np.where(self.is_cylinder[:, None], disc, box)
        return np.stack([(self.center - extent).min(0), (self.center + extent).max(0)])

    def to_float32(self) -> "Solids":
        """Casts the geometry to single precision."""
        return self._replace(**{key: getattr(self, key).astype(np.float32) for key in ("center", "half_size", "axes")})


@functools.cache
def load_bulldozer() -> Solids:
    """Loads the bulldozer of the built-in scene. Front is +y, up is +z; 1.3 x 2.2 x 1.5 world units."""
    model = json.loads(Path(__file__).with_name("bulldozer.json").read_text(encoding="utf-8"))
    kinds, names, *geometry = zip(*((*row, IDENTITY_AXES)[:5] for row in model["solids"]), strict=True)
    materials = [model["materials"][name] for name in names]
    keys = ("color", "accent", "period", "gloss")
    appearance = {key: np.array([material[key] for material in materials], np.float32) for key in keys}
    pattern = np.array([PATTERNS.index(material["pattern"]) for material in materials])
    center, half, axes = (np.array(part, float) for part in geometry)
    return Solids(np.array(kinds) == "cylinder", center, half, axes, pattern=pattern, **appearance)
