"""The box to sample in, estimated from cameras and silhouettes."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, focus_point
from nerf_lightning.dataset.scene import Views

GRID = 48
"""Voxels along each axis of the carving grid."""
MAX_VIEWS = 32
ALPHA_FLOOR = 0.02
COLOUR_FLOOR = 3
"""In 1/255: JPEG-free renders are exact, resampled ones wobble by one or two."""
FLAT = 0.9
"""Share of the border's pixels that must have one colour to be the background: the rest is content that leaves the picture."""
AGREEMENT = 0.95
"""Share of the views seeing a voxel that must find it in the silhouette; the rest forgives dark-on-dark pixels."""


def estimate_bounds(
    views: Views,
    background: tuple[float, float, float],
    near: float | None = None,
    far: float | None = None,
) -> Bounds:
    """A bounded box around the content, in world units.

    First a cube around the point the cameras look at, as wide as they see there. Where silhouettes are known, from alpha
    or from a flat `background` (sRGB in [0, 1]), the visual hull on a coarse grid shrinks it, twice.
    """
    aabb = visible_cube(views.cameras)
    views = views.spread(MAX_VIEWS)
    masks = silhouettes(views, background)
    if masks is not None:
        # The second pass sees finer voxels, so the box loses the slack of the first.
        for _ in range(2):
            kept = _carve(aabb, masks, views.cameras)
            if kept is None:
                break
            aabb = kept
    return Bounds(torch.from_numpy(aabb).float(), unbounded=False, near=near, far=far)


def silhouettes(views: Views, background: tuple[float, float, float]) -> Bool[np.ndarray, "V H W"] | None:
    """Which pixels show content; None where neither alpha nor a flat background at the borders tells."""
    images = views.images.numpy()
    if images.shape[3] == 4:
        return images[..., 3] > ALPHA_FLOOR * 255
    colour = np.rint(np.array(background) * 255).astype(np.int16)
    masks = np.stack([(np.abs(image - colour) > COLOUR_FLOOR).any(-1) for image in images])
    border = np.concatenate([masks[:, 0], masks[:, -1], masks[:, :, 0], masks[:, :, -1]], axis=1)
    flat = border.mean(1) < 0.2
    return masks if flat.mean() > 0.5 else None


def border_colour(images: UInt8[Tensor, "V H W C"]) -> tuple[float, float, float] | None:
    """The one colour along the borders of photos without alpha, sRGB in [0, 1]; None where they have several, or alpha."""
    if images.shape[3] == 4:
        return None
    edges = torch.cat([images[:, 0], images[:, -1], images[:, :, 0], images[:, :, -1]], dim=1).flatten(0, 1).int()
    middle = edges.median(0).values
    alike = ((edges - middle).abs() <= COLOUR_FLOOR).all(1).float().mean()
    if float(alike) < FLAT:
        return None
    red, green, blue = (middle / 255).tolist()
    return red, green, blue


def viewing_distance(c2w: Float[Tensor, "V 4 4"], centre: Float[Tensor, "3"]) -> float:
    """Median distance of the cameras to `centre`, in the scene's unit; 1 where all stand on that very spot."""
    distance = float((c2w[:, :3, 3] - centre).norm(dim=-1).median())
    return distance if distance > 1e-5 * (1 + float(centre.norm())) else 1.0


def visible_cube(cameras: Cameras) -> Float[np.ndarray, "2 3"]:
    """A cube around the point the cameras look at, as wide as they see there, in world units."""
    centre = focus_point(cameras.c2w)
    distance = viewing_distance(cameras.c2w, centre)
    tangent = max(cameras.width / float(cameras.K[:, 0, 0].min()), cameras.height / float(cameras.K[:, 1, 1].min())) / 2
    half = distance * tangent
    return np.stack([centre.numpy() - half, centre.numpy() + half]).astype(np.float64)


@dataclass(frozen=True)
class Sighting:
    """The voxels of a grid, N in all, as one view sees them."""

    inside: Bool[np.ndarray, "N"]
    """Which are in the picture."""
    column: Int[np.ndarray, "N"]
    row: Int[np.ndarray, "N"]
    """The pixel of each voxel's centre; 0 where it is not in the picture."""
    reach: int
    """Half a voxel's diagonal, pixels: any part of a voxel may be content, or show some."""

    def grown(self, mask: Shaped[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W"]:
        """A mask wider by the reach."""
        return cv2.dilate(mask.astype(np.uint8), np.ones((2 * self.reach + 1, 2 * self.reach + 1), np.uint8))

    def found_in(self, mask: Bool[np.ndarray, "H W"]) -> Bool[np.ndarray, "N"]:
        """Which voxels have a part inside a mask."""
        return self.inside & (self.grown(mask)[self.row, self.column] > 0)


def voxel_centres(aabb: Float[np.ndarray, "2 3"], count: int) -> Float[np.ndarray, "3 count"]:
    """Coordinates of the middles of `count` voxels along each axis of a box."""
    voxel = (aabb[1] - aabb[0]) / count
    return aabb[0][:, None] + (np.arange(count) + 0.5) * voxel[:, None]


def sightings(aabb: Float[np.ndarray, "2 3"], count: int, cameras: Cameras) -> Iterator[Sighting]:
    """A box of count^3 voxels, in the order of their indices, as each camera sees it."""
    x, y, z = voxel_centres(aabb, count)
    diagonal = np.linalg.norm((aabb[1] - aabb[0]) / count)
    for K, c2w in zip(cameras.K.double().numpy(), cameras.c2w.double().numpy(), strict=True):
        # P = K [R t; 0 1]^-1 maps world to pixels. On a grid it is a sum of one term an axis, cheaper than products.
        P = K @ np.linalg.inv(c2w)[:3]
        u, v, depth = ((p[0] * x[:, None, None] + p[1] * y[:, None] + (p[2] * z + p[3])).reshape(-1) for p in P)
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = u / depth, v / depth
        inside = (depth > 0) & (u >= 0) & (v >= 0) & (u < cameras.width) & (v < cameras.height)
        column, row = (np.where(inside, pixel, 0).astype(np.int32) for pixel in (u, v))
        nearness = float(np.median(depth[inside])) if inside.any() else np.inf
        reach = int(min(np.ceil(0.5 * diagonal * K[0, 0] / nearness), max(cameras.width, cameras.height)))
        yield Sighting(inside, column, row, reach)


def visual_hull(masks: Bool[np.ndarray, "V H W"], sightings: Iterable[Sighting], least: float) -> Bool[np.ndarray, "N"]:
    """Which voxels at least `least` views see, and nearly all of these find in their silhouettes."""
    seen: Any = 0
    found: Any = 0
    for mask, sighting in zip(masks, sightings, strict=True):
        seen = seen + sighting.inside
        found = found + sighting.found_in(mask)
    return (seen >= least) & (found >= AGREEMENT * seen)


def _carve(
    aabb: Float[np.ndarray, "2 3"], masks: Bool[np.ndarray, "V H W"], cameras: Cameras
) -> Float[np.ndarray, "2 3"] | None:
    """The box of the voxels inside (nearly) all silhouettes, one voxel wider; None when there are none."""
    voxel = (aabb[1] - aabb[0]) / GRID
    centres = np.stack(np.meshgrid(*voxel_centres(aabb, GRID), indexing="ij"), axis=-1).reshape(-1, 3)
    kept = centres[visual_hull(masks, sightings(aabb, GRID, cameras), least=0.5 * len(masks))]
    if len(kept) == 0:
        return None
    return np.stack([kept.min(0) - 1.5 * voxel, kept.max(0) + 1.5 * voxel])
