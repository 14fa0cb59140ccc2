"""The box to sample in, estimated from cameras and silhouettes."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.views import Views

Masks = Sequence[Bool[np.ndarray, "_ _"]]
GRID, COARSE_GRID = 48, 40
"""Voxels along each axis of the grid that is carved, and of the one that tells whether silhouettes fit each other."""
MAX_VIEWS = 32
ALPHA_FLOOR = 0.02
COLOUR_FLOOR = 3
"""In 1/255: JPEG-free renders are exact, resampled ones wobble by one or two."""
FLAT = 0.75
"""Least share of the borders' pixels that have the background's colour; the rest is content that leaves the picture."""
AGREEMENT = 0.95
"""Share of the views seeing a voxel that must find it in the silhouette; the rest forgives dark-on-dark pixels."""


class VoxelView(NamedTuple):
    """The N voxels of a grid as one view sees them."""

    inside: Bool[np.ndarray, "N"]
    """Which are in the picture."""
    row: Int[np.ndarray, "N"]
    column: Int[np.ndarray, "N"]
    """The pixel of each voxel's centre; 0 where it is not in the picture."""
    footprint: UInt8[np.ndarray, "F F"]
    """Ones as far as half a voxel's diagonal reaches: any part of a voxel may be content, or show some."""


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
    masks = silhouettes(views, background) or []
    # The second pass sees finer voxels, so the box loses the slack of the first.
    for _ in range(2 if masks else 0):
        hull = visual_hull(masks, view_voxels(aabb, GRID, views.cameras), least=0.5 * len(masks))
        if hull.any():
            kept, voxel = make_grid(aabb, GRID)[hull], (aabb[1] - aabb[0]) / GRID
            aabb = np.stack([kept.min(0) - 1.5 * voxel, kept.max(0) + 1.5 * voxel])
    return Bounds(torch.from_numpy(aabb).float(), unbounded=False, near=near, far=far)


def silhouettes(views: Views, background: tuple[float, float, float]) -> list[Bool[np.ndarray, "_ _"]] | None:
    """Which pixels of each photo show content; None where neither alpha nor a flat background at the borders tells.

    Masked pixels may show content.
    """
    images = [views.image(view).numpy() for view in range(len(views))]
    if views.channels == 4:
        masks = [image[..., 3] > ALPHA_FLOOR * 255 for image in images]
    else:
        colour = np.rint(np.array(background) * 255).astype(np.int16)
        masks = [(np.abs(image - colour) > COLOUR_FLOOR).any(-1) for image in images]
    if views.known is not None:
        masks = [mask | ~views.mask_of(view).numpy() for view, mask in enumerate(masks)]
    flat = [take_border(mask).mean() < 0.2 for mask in masks]
    return masks if views.channels == 4 or np.mean(flat) > 0.5 else None


def take_border(image: Shaped[np.ndarray, "H W *C"]) -> Shaped[np.ndarray, "B *C"]:
    """The pixels along the border of a picture."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def border_colour(views: Views) -> tuple[float, float, float] | None:
    """The one colour along the borders of photos without alpha, sRGB in [0, 1]; None where they have several, or alpha."""
    if views.channels == 4:
        return None
    borders = []
    for view in range(len(views)):
        border = take_border(views.image(view).numpy())
        borders.append(border if views.known is None else border[take_border(views.mask_of(view).numpy())])
    edges = torch.from_numpy(np.concatenate(borders)).int()
    if not len(edges):
        return None
    middle = edges.median(0).values
    alike = ((edges - middle).abs() <= COLOUR_FLOOR).all(1).float().mean()
    if float(alike) < FLAT:
        return None
    red, green, blue = (middle / 255).tolist()
    return red, green, blue


def visible_cube(cameras: Cameras) -> Float[np.ndarray, "2 3"]:
    """A cube around the region that the cameras show, as wide as they see there, in world units."""
    region = find_region(cameras.c2w)
    tangent = float((cameras.sizes / cameras.K[:, [0, 1], [0, 1]].cpu()).max()) / 2
    centre, half = region.centre.cpu().numpy(), region.unit * tangent
    return np.stack([centre - half, centre + half])


def make_grid(aabb: Float[np.ndarray, "2 3"], count: int) -> Float[np.ndarray, "N 3"]:
    """The centres of count^3 voxels in a box."""
    steps = aabb[0][:, None] + (np.arange(count) + 0.5) * ((aabb[1] - aabb[0]) / count)[:, None]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def view_voxels(aabb: Float[np.ndarray, "2 3"], count: int, cameras: Cameras) -> Iterator[VoxelView]:
    """A box of count^3 voxels, in the order of their indices, as each camera sees it."""
    points = torch.from_numpy(make_grid(aabb, count)).float()
    diagonal = np.linalg.norm((aabb[1] - aabb[0]) / count)
    for view in range(len(cameras)):
        pixels, depth, seen = cameras.project(points, view)
        inside = seen.numpy()
        column, row = np.where(inside, pixels.T.numpy(), 0).astype(np.int32)
        nearness = float(depth[seen].median()) if inside.any() else np.inf
        focal = float(cameras.K[view, 0, 0])
        reach = int(min(np.ceil(0.5 * diagonal * focal / nearness), cameras.longest))
        yield VoxelView(inside, row, column, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))


def visual_hull(masks: Masks, voxels: Iterable[VoxelView], least: float) -> Bool[np.ndarray, "N"]:
    """Which voxels at least `least` views see, and nearly all of these find in their silhouettes."""
    seen: Any = 0
    found: Any = 0
    for mask, (inside, row, column, footprint) in zip(masks, voxels, strict=True):
        seen = seen + inside
        found = found + (inside & (cv2.dilate(mask.astype(np.uint8), footprint)[row, column] > 0))
    return (seen >= least) & (found >= AGREEMENT * seen)


def hull_coverage(masks: Masks, cameras: Cameras, bounds: Bounds) -> float:
    """Share of the silhouettes that their visual hull within the bounds covers, in [0, 1]."""
    voxels = list(view_voxels(bounds.aabb.double().numpy(), COARSE_GRID, cameras))
    hull = visual_hull(masks, voxels, least=1)
    covered = []
    for mask, (inside, row, column, footprint) in zip(masks, voxels, strict=True):
        shown = np.zeros(mask.shape, np.uint8)
        shown[row[hull & inside], column[hull & inside]] = 1
        if mask.any():
            covered.append(cv2.dilate(shown, footprint)[mask].mean())
    return float(np.mean(covered)) if covered else 1.0
