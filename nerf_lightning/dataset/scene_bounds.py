"""Scene bounds estimated from cameras and silhouettes (visual hull)."""

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
"""Voxels per axis of the visual hull for bounds, and for the silhouette consistency check."""
MAX_HULL_VIEWS = 32
MIN_ALPHA = 0.02
COLOR_TOLERANCE = 3
"""In 1/255: uncompressed renders are exact, resampled ones off by one or two."""
MIN_BACKGROUND_FRACTION = 0.75
"""Minimum fraction of border pixels with the background color; the rest is content that leaves the picture."""
MIN_VIEW_AGREEMENT = 0.95
"""Minimum fraction of the views of a voxel with it in the silhouette; the rest tolerates dark-on-dark pixels."""


class VoxelProjection(NamedTuple):
    """Projection of a grid of N voxels into one view."""

    inside: Bool[np.ndarray, "N"]
    """Whether each center is in the picture."""
    row: Int[np.ndarray, "N"]
    column: Int[np.ndarray, "N"]
    """Pixel of each voxel's center; 0 outside the picture."""
    footprint: UInt8[np.ndarray, "F F"]
    """Dilation kernel that covers half a voxel's diagonal: any part of a voxel may be content."""


def estimate_bounds(
    views: Views, background: tuple[float, float, float], near: float | None = None, far: float | None = None
) -> Bounds:
    """Estimates a bounding box of the content, in world units.

    Starts from a cube around the cameras' focus point, as wide as their field of view. If silhouettes are known, from alpha
    or a flat `background` (sRGB in [0, 1]), the visual hull on a coarse grid shrinks it twice.
    """
    aabb = estimate_visible_cube(views.cameras)
    views = views.subsample(MAX_HULL_VIEWS)
    masks = extract_silhouettes(views, background) or []
    # The second pass has finer voxels, which tightens the box.
    for _ in range(2 if masks else 0):
        voxels = project_voxels(aabb, HULL_RESOLUTION, views.cameras)
        hull = carve_visual_hull(masks, voxels, min_views=0.5 * len(masks))
        if hull.any():
            kept, voxel = list_voxel_centers(aabb, HULL_RESOLUTION)[hull], (aabb[1] - aabb[0]) / HULL_RESOLUTION
            aabb = np.stack([kept.min(0) - 1.5 * voxel, kept.max(0) + 1.5 * voxel])
    return Bounds(torch.from_numpy(aabb).float(), unbounded=False, near=near, far=far)


def extract_silhouettes(views: Views, background: tuple[float, float, float]) -> list[Bool[np.ndarray, "_ _"]] | None:
    """Extracts the content mask of each photo; None without alpha or a flat background. Masked pixels count as content."""
    images = [views.image(view).numpy() for view in range(len(views))]
    if views.channels == 4:
        masks = [image[..., 3] > MIN_ALPHA * 255 for image in images]
    else:
        color = np.rint(np.array(background) * 255).astype(np.int16)
        masks = [(np.abs(image - color) > COLOR_TOLERANCE).any(-1) for image in images]
    if views.valid_mask is not None:
        masks = [mask | ~views.view_mask(view).numpy() for view, mask in enumerate(masks)]
    has_flat_border = [extract_border(mask).mean() < 0.2 for mask in masks]
    return masks if views.channels == 4 or np.mean(has_flat_border) > 0.5 else None


def extract_border(image: Shaped[np.ndarray, "H W *C"]) -> Shaped[np.ndarray, "B *C"]:
    """Extracts the border pixels of an image."""
    return np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])


def find_border_color(views: Views) -> tuple[float, float, float] | None:
    """Finds the uniform border color of photos without alpha, sRGB in [0, 1]; None if there is none."""
    if views.channels == 4:
        return None
    borders = []
    for view in range(len(views)):
        border = extract_border(views.image(view).numpy())
        borders.append(border if views.valid_mask is None else border[extract_border(views.view_mask(view).numpy())])
    pixels = torch.from_numpy(np.concatenate(borders)).int()
    if not len(pixels):
        return None
    median = pixels.median(0).values
    is_background = ((pixels - median).abs() <= COLOR_TOLERANCE).all(1).float().mean()
    if float(is_background) < MIN_BACKGROUND_FRACTION:
        return None
    red, green, blue = (median / 255).tolist()
    return red, green, blue


def estimate_visible_cube(cameras: Cameras) -> Float[np.ndarray, "2 3"]:
    """Estimates a cube around the region of interest, as wide as the field of view there, in world units."""
    region = find_region(cameras.c2w)
    tangent = float((cameras.sizes / cameras.K[:, [0, 1], [0, 1]].cpu()).max()) / 2
    center, half = region.center.cpu().numpy(), region.unit * tangent
    return np.stack([center - half, center + half])


def list_voxel_centers(aabb: Float[np.ndarray, "2 3"], count: int) -> Float[np.ndarray, "N 3"]:
    """Lists the centers of count^3 voxels in a box."""
    steps = aabb[0][:, None] + (np.arange(count) + 0.5) * ((aabb[1] - aabb[0]) / count)[:, None]
    return np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)


def project_voxels(aabb: Float[np.ndarray, "2 3"], count: int, cameras: Cameras) -> Iterator[VoxelProjection]:
    """Projects a box of count^3 voxels into each camera."""
    points = torch.from_numpy(list_voxel_centers(aabb, count)).float()
    diagonal = np.linalg.norm((aabb[1] - aabb[0]) / count)
    for view in range(len(cameras)):
        pixels, depth, visible = cameras.project(points, view)
        inside = visible.numpy()
        column, row = np.where(inside, pixels.T.numpy(), 0).astype(np.int32)
        median_depth = float(depth[visible].median()) if inside.any() else np.inf
        focal = float(cameras.K[view, 0, 0])
        radius = int(min(np.ceil(0.5 * diagonal * focal / median_depth), cameras.max_side))
        yield VoxelProjection(inside, row, column, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8))


def carve_visual_hull(masks: Masks, voxels: Iterable[VoxelProjection], min_views: float) -> Bool[np.ndarray, "N"]:
    """Carves the visual hull: voxels seen by `min_views` views, and in the silhouettes of nearly all of these."""
    num_views: Any = 0
    num_hits: Any = 0
    for mask, (inside, row, column, footprint) in zip(masks, voxels, strict=True):
        num_views = num_views + inside
        num_hits = num_hits + (inside & (cv2.dilate(mask.astype(np.uint8), footprint)[row, column] > 0))
    return (num_views >= min_views) & (num_hits >= MIN_VIEW_AGREEMENT * num_views)


def measure_hull_coverage(masks: Masks, cameras: Cameras, bounds: Bounds) -> float:
    """Computes the fraction of the silhouettes covered by their visual hull within the bounds, in [0, 1]."""
    voxels = list(project_voxels(bounds.aabb.double().numpy(), COVERAGE_RESOLUTION, cameras))
    hull = carve_visual_hull(masks, voxels, min_views=1)
    coverages = []
    for mask, (inside, row, column, footprint) in zip(masks, voxels, strict=True):
        rendered = np.zeros(mask.shape, np.uint8)
        rendered[row[hull & inside], column[hull & inside]] = 1
        if mask.any():
            coverages.append(cv2.dilate(rendered, footprint)[mask].mean())
    return float(np.mean(coverages)) if coverages else 1.0
