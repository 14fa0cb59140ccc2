"""Shading of solids: patterns, two lights, a highlight that moves with the viewer."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from nerf_lightning.dataset.bricks.solids import BRICKWORK, CHEQUER, STRIPES, Solids

LIGHT = np.array([4.5, 5.0, 10.0])
"""Position of the key light, world frame; no fall-off with distance."""
FILL = np.array([-0.65, -0.60, 0.45], np.float32) / np.float32(np.sqrt(0.985))
"""Unit direction towards the fill light, which casts no shadow."""
SKY, FLOOR = np.array([0.30, 0.32, 0.36], np.float32), np.array([0.13, 0.12, 0.10], np.float32)

Lit = Callable[[Int[np.ndarray, "N"], Float[np.ndarray, "N 3"]], Bool[np.ndarray, "N"]]
"""Whether the key light reaches points (world frame) on the given solids."""


def shade(
    solids: Solids,
    solid: Int[np.ndarray, "N"],
    points: Float[np.ndarray, "N 3"],
    directions: Float[np.ndarray, "N 3"],
    lit: Lit,
) -> Float[np.ndarray, "N 3"]:
    """Colour of surface points as seen along unit view directions: Lambert, ambient and Blinn-Phong.

    Only + - * / and sqrt are used, which IEEE 754 fixes to the last bit, so that the pictures are the same everywhere.

    Args:
        solid: which solid each point lies on.
        points: world frame.
        directions: unit, from the viewer to the point.
        lit: the shadow test.

    Returns:
        sRGB in [0, 1].
    """
    normals, albedo = _surface(solids, solid, points)
    to_light = _normalise(LIGHT.astype(points.dtype) - points)
    key = np.maximum(_dot(normals, to_light), 0) * lit(solid, points)
    fill = np.maximum(_dot(normals, FILL.astype(points.dtype)), 0)
    up = (normals[:, 2:] + 1) / 2
    light = FLOOR + (SKY - FLOOR) * up + 0.80 * key[:, None] + 0.32 * fill[:, None]
    halfway = _normalise(to_light - directions)
    highlight = np.maximum(_dot(normals, halfway), 0)
    for _ in range(5):  # to the power 32
        highlight = highlight * highlight
    highlight = highlight * (key > 0) * solids.gloss[solid]
    # A square root stands for the sRGB curve.
    return np.sqrt(np.minimum(albedo * light + highlight[:, None], 1)).astype(np.float32)


def _surface(
    solids: Solids, solid: Int[np.ndarray, "N"], points: Float[np.ndarray, "N 3"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Unit normals (world frame) and albedo."""
    dtype = points.dtype
    axes = solids.axes.astype(dtype)[solid]
    half = solids.half.astype(dtype)[solid]
    offset = points - solids.centre.astype(dtype)[solid]
    local = np.stack([_dot(axes[:, k], offset) for k in range(3)], axis=-1)
    unit = local / half
    size = np.abs(unit)
    round_ = solids.cylinder[solid]
    radial = np.where(round_, np.sqrt(unit[:, 0] * unit[:, 0] + unit[:, 1] * unit[:, 1]), 0)
    size[:, 0] = np.where(round_, radial, size[:, 0])
    size[:, 1] = np.where(round_, 0, size[:, 1])
    face = size.argmax(-1)
    normal = np.where(np.arange(3) == face[:, None], np.sign(unit), 0)
    curved = np.flatnonzero(round_ & (face == 0))
    normal[curved, :2] = unit[curved, :2] / radial[curved, None]
    normals = normal[:, :1] * axes[:, 0] + normal[:, 1:2] * axes[:, 1] + normal[:, 2:] * axes[:, 2]

    albedo = solids.colour[solid]
    patterned = np.flatnonzero(solids.pattern[solid])
    which = solid[patterned]
    accent = _accented(solids.pattern[which], solids.period[which], (local + half)[patterned], face[patterned])
    chosen = patterned[accent]
    albedo[chosen] = solids.accent[solid[chosen]]
    return normals, albedo


def _accented(
    pattern: Int[np.ndarray, "N"],
    period: Float[np.ndarray, "N"],
    place: Float[np.ndarray, "N 3"],
    face: Int[np.ndarray, "N"],
) -> Bool[np.ndarray, "N"]:
    """Where a pattern shows its second colour, given the place in the solid (from its lower corner) and the face."""
    # Along the face: u is horizontal on a side, v is vertical; x and y on a top.
    u = np.where(face == 0, place[:, 1], place[:, 0])
    v = np.where(face == 2, place[:, 1], place[:, 2])
    chequer = (np.floor(u / period) + np.floor(v / period)) % 2 == 1
    stripes = np.floor((u + v) / period) % 2 == 1
    # Courses one period high of bricks three long, every other course moved by half a brick.
    course = np.floor(v / period)
    length = period * 3.0
    run = (u + (course % 2) * length / 2) % length
    joint = np.minimum(run, v - course * period) < 0.09 * period
    return np.select([pattern == CHEQUER, pattern == STRIPES, pattern == BRICKWORK], [chequer, stripes, joint], False)


def _dot(a: Float[np.ndarray, "*#N 3"], b: Float[np.ndarray, "*#N 3"]) -> Float[np.ndarray, "*N"]:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _normalise(a: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    return a / np.sqrt(_dot(a, a))[:, None]
