"""Surface extraction from densities: no floaters, and no cavities inside solids."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage

from nerf_lightning.cameras import Cameras
from nerf_lightning.errors import InputError
from nerf_lightning.export.volume import CELL_WIDTH_PIXELS, Volume
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.progress import track_progress

HISTOGRAM_BINS = 128
MIN_CELL_OPACITY = 0.02
"""Opacity below which a cell is empty, and ignored by Otsu's method."""
MISS_DISTANCE = 1e9
"""Depth of a ray without a hit."""
MAX_VISIBILITY_SIDE = 300
"""Longest side of the views rendered for visibility, pixels."""
MAX_FLOATER_FRACTION = 0.01
"""Size of a connected component, relative to the largest, below which it is removed."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh in the world frame."""

    vertices: Float[ndarray, "V 3"]
    faces: ndarray
    """[F, 3] vertex indices, counterclockwise from outside."""
    normals: Float[ndarray, "V 3"]
    """Unit outward normals."""
    threshold: float
    """Opacity of a cell at the surface."""
    floaters: int
    """Number of components removed."""


def compute_otsu_threshold(values: Float[ndarray, "N"]) -> float:
    """Otsu's upper threshold for three classes: haze, blurred boundaries and solids (Otsu 1979, section IV); 0.5 if empty.

    With two classes and much haze, the threshold would lie within the haze.
    """
    from skimage.filters import threshold_multiotsu

    if not len(values):
        return 0.5
    low, high = float(values.min()), float(values.max())
    if len(np.flatnonzero(np.histogram(values, HISTOGRAM_BINS)[0])) < 3:
        return (low + high) / 2 if low < high else high / 2
    # scikit-image returns the center of a bin that belongs below the threshold.
    threshold = threshold_multiotsu(values, 3, HISTOGRAM_BINS)[1] + (high - low) / HISTOGRAM_BINS / 2
    # Between two separate classes, take the middle of the gap.
    above = values > threshold
    return float(values[~above].max() + values[above].min()) / 2


@torch.no_grad()
def find_unoccluded_cells(system: NeRF3D, volume: Volume, cameras: Cameras) -> Bool[ndarray, "X Y Z"]:
    """Cells in front of the rendered surface in at least one view; all others are inside solids.

    Args:
        system: the volume's source.
        volume: grid of cells.
        cameras: training views.
    """
    centers = volume.centers.view(-1, 3)
    occluded = torch.arange(len(centers))
    cameras = cameras.rescale(min(1.0, MAX_VISIBILITY_SIDE / cameras.max_side))
    # A slanted surface has many depths within a pixel: the tolerance is at least the pixel's width.
    tolerance = max(volume.cell, CELL_WIDTH_PIXELS * cameras.pixel_footprint(system.field.bounds.content_center.cpu()))
    for view in track_progress(range(len(cameras)), len(cameras), "views"):
        rendered = system.render(cameras.generate_view_rays(view).to(system.device))
        depths = torch.where(rendered.opacity > 0.5, rendered.depth, MISS_DISTANCE).cpu() + tolerance
        # At silhouettes, depth averages near and far: dilate by the 3 x 3 neighborhood.
        width, height = cameras.size(view)
        depths = -torch.nn.functional.max_pool2d(-depths.view(1, height, width), 3, 1, 1).flatten()
        pixels, _, seen = cameras.project(centers[occluded], view)
        col, row = torch.where(seen[:, None], pixels, 0.0).long().unbind(1)
        max_distance = torch.where(seen, depths[row * width + col], 0.0)
        occluded = occluded[(centers[occluded] - cameras.centers[view]).norm(dim=1) > max_distance]
    unoccluded = torch.ones(len(centers), dtype=torch.bool)
    unoccluded[occluded] = False
    return unoccluded.view(volume.density.shape).numpy()


def fill_bounding_box(mask: Bool[ndarray, "X Y Z"]) -> Bool[ndarray, "X Y Z"]:
    """Mask of the bounding box of a mask: occluded cells outside it, such as below a floor, are not inside a solid."""
    box = np.zeros(mask.shape, bool)
    for region in ndimage.find_objects(mask.astype(int)):
        box[region] = True
    return box


def extract_surface(volume: Volume, unoccluded: Bool[ndarray, "X Y Z"], threshold: float | None = None) -> Surface:
    """Extracts the surface of dense or occluded cells by marching cubes (Lewiner et al. 2003).

    Args:
        volume: densities.
        unoccluded: see `find_unoccluded_cells`; occluded cells count as solid.
        threshold: opacity of a cell at the surface, in (0, 1); None: Otsu's method on unoccluded cells.

    Raises:
        InputError: no cell is above the threshold.
    """
    from skimage.measure import marching_cubes

    level = volume.opacity.numpy()
    if threshold is None:
        threshold = compute_otsu_threshold(level[unoccluded & (level > MIN_CELL_OPACITY)])
    max_opacity = level.max()
    level = np.where(unoccluded | ~fill_bounding_box(unoccluded & (level > threshold)), level, 1.0)
    components, _ = ndimage.label(level > threshold, structure=np.ones((3, 3, 3)))
    if not max_opacity > threshold:
        problem, expected = f"nothing above an opacity of {threshold:.2f} a cell", f"at most {max_opacity:.2f}"
        raise InputError("export", "threshold", problem, expected, "train longer, or lower --threshold")
    sizes = np.bincount(components.ravel())[1:]
    floating = np.flatnonzero(sizes < MAX_FLOATER_FRACTION * sizes.max()) + 1
    # Remove floaters with the haze around them; pad to close the surface at the box.
    removed = np.isin(components, floating)
    level[ndimage.binary_dilation(removed, np.ones((3, 3, 3))) & (removed | (components == 0))] = 0
    vertices, faces, normals, _ = marching_cubes(np.pad(level, 1), threshold)
    positions = volume.index_to_world(torch.from_numpy(vertices - 1).float()).numpy()
    return Surface(positions, faces[:, ::-1].copy(), normals.astype(np.float32), float(threshold), len(floating))
