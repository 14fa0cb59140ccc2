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
HULL_RESOLUTION, COVERAGE_RESOLUTION = 48, 40
"""Voxels along each axis of the grid that is carved, and of the one that tells whether silhouettes fit each other."""
MAX_HULL_VIEWS = 32
MIN_ALPHA = 0.02
COLOUR_TOLERANCE = 3
"""In 1/255: JPEG-free renders are exact, resampled ones wobble by one or two."""
MIN_BACKGROUND_FRACTION = 0.75
"""Least share of the borders' pixels that have the background's colour; the rest is content that leaves the picture."""
MIN_VIEW_AGREEMENT = 0.95
"""Share of the views seeing a voxel that must find it in the silhouette; the rest forgives dark-on-dark pixels."""


class VoxelProjection(NamedTuple):
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
    aabb = estimate_visible_cube(views.cameras)
    views = views.subsample(MAX_HULL_VIEWS)
    masks = extract_silhouettes(views, background) or []
    # The second pass sees finer voxels, so the box loses the slack of the first.
    for _ in range(2 if masks else 0):
        hull = carve_visual_hull(
            masks, project_voxels(aabb, HULL_RESOLUTION, views.cameras), min_views=0.5 * len(masks)
        )
        if hull.any():
            kept, voxel = list_voxel_centres(aabb, HULL_RESOLUTION)[hull], (aabb[1] - aabb[0]) / HULL_RESOLUTION
            aabb = np.stack([kept.min(0) - 1.5 * voxel, kept.max(0) + 1.5 * voxel])
    return Bounds(torch.from_numpy(aabb).float(), unbounded=False, near=near, far=far)


def extract_silhouettes(views: Views, background: tuple[float, float, float]) -> list[Bool[np.ndarray, "_ _"]] | None:
    """Which pixels of each photo show content; None where neither alpha nor a flat background at the borders tells.

    Masked pixels may show content.
    """
    images = [views.image(view).numpy() for view in range(len(views))]
    if views.channels == 4:
        masks = [image[..., 3] > MIN_ALPHA * 255 for image in images]
    else:
        colour = np.rint(np.array(background) * 255).astype(np.int16)
        masks = [(np.abs(image - colour) > COLOUR_TOLERANCE).any(-1) for image in images]
    if views.valid_mask is not None:
        masks = [mask | ~views.view_mask(view).numpy() for view, mask in enumerate(masks)]
    flat = [extract_border(mask).mean() < 0.2 for mask in masks]
    return masks if views.channels == 4 or np.mean(flat) > 0.5 else None


def extract_border(image: Shaped[np.ndarray, "H W *C"]) -> Shaped[np.ndarray, "B *C"]:
    """The pixels along the border of a picture."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def find_border_colour(views: Views) -> tuple[float, float, float] | None:
    """The one colour along the borders of photos without alpha, sRGB in [0, 1]; None where they have several, or alpha."""
    if views.channels == 4:
        return None
    borders = []
    for view in range(len(views)):
        border = extract_border(views.image(view).numpy())
        borders.append(border if views.valid_mask is None else border[extract_border(views.view_mask(view).numpy())])
    edges = torch.from_numpy(np.concatenate(borders)).int()
    if not len(edges):
        return None
    middle = edges.median(0).values
    alike = ((edges - middle).abs() <= COLOUR_TOLERANCE).all(1).float().mean()
    if float(alike) < MIN_BACKGROUND_FRACTION:
        return None
    red, green, blue = (middle / 255).tolist()
    return red, green, blue


def estimate_visible_cube(cameras: Cameras) -> Float[np.ndarray, "2 3"]:
    """A cube around the region that the cameras show, as wide as they see there, in world units."""
    region = find_region(cameras.c2w)
    tangent = float((cameras.sizes / cameras.K[:, [0, 1], [0, 1]].cpu()).max()) / 2
    centre, half = region.centre.cpu().numpy(), region.unit * tangent
    return np.stack([centre - half, centre + half])


def list_voxel_centres(aabb: Float[np.ndarray, "2 3"], count: int) -> Float[np.ndarray, "N 3"]:
    """The centres of count^3 voxels in a box."""
    steps = aabb[0][:, None] + (np.arange(count) + 0.5) * ((aabb[1] - aabb[0]) / count)[:, None]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def project_voxels(aabb: Float[np.ndarray, "2 3"], count: int, cameras: Cameras) -> Iterator[VoxelProjection]:
    """A box of count^3 voxels, in the order of their indices, as each camera sees it."""
    points = torch.from_numpy(list_voxel_centres(aabb, count)).float()
    diagonal = np.linalg.norm((aabb[1] - aabb[0]) / count)
    for view in range(len(cameras)):
        pixels, depth, seen = cameras.project(points, view)
        inside = seen.numpy()
        column, row = np.where(inside, pixels.T.numpy(), 0).astype(np.int32)
        nearness = float(depth[seen].median()) if inside.any() else np.inf
        focal = float(cameras.K[view, 0, 0])
        reach = int(min(np.ceil(0.5 * diagonal * focal / nearness), cameras.max_side))
        yield VoxelProjection(inside, row, column, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))


def carve_visual_hull(masks: Masks, voxels: Iterable[VoxelProjection], min_views: float) -> Bool[np.ndarray, "N"]:
    """Which voxels at least `min_views` views see, and nearly all of these find in their silhouettes."""
    seen: Any = 0
    found: Any = 0
    for mask, (inside, row, column, footprint) in zip(masks, voxels, strict=True):
        seen = seen + inside
        found = found + (inside & (cv2.dilate(mask.astype(np.uint8), footprint)[row, column] > 0))
    return (seen >= min_views) & (found >= MIN_VIEW_AGREEMENT * seen)


def measure_hull_coverage(masks: Masks, cameras: Cameras, bounds: Bounds) -> float:
    """Share of the silhouettes that their visual hull within the bounds covers, in [0, 1]."""
    voxels = list(project_voxels(bounds.aabb.double().numpy(), COVERAGE_RESOLUTION, cameras))
    hull = carve_visual_hull(masks, voxels, min_views=1)
    covered = []
    for mask, (inside, row, column, footprint) in zip(masks, voxels, strict=True):
        shown = np.zeros(mask.shape, np.uint8)
        shown[row[hull & inside], column[hull & inside]] = 1
        if mask.any():
            covered.append(cv2.dilate(shown, footprint)[mask].mean())
    return float(np.mean(covered)) if covered else 1.0
