"""From densities to a surface, without floating pieces and without what is hidden inside a solid."""

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
"""Opacity of a cell below which it is empty, and left out when the threshold is chosen."""
MISS_DISTANCE = 1e9
"""Where a ray ends that meets nothing."""
MAX_VISIBILITY_SIDE = 300
"""Most pixels along a view's longer side when visibility is rendered."""
MAX_FLOATER_FRACTION = 0.01
"""A piece with fewer cells than this share of the largest is left out."""


@dataclass(frozen=True)
class Surface:
    """Triangles around the solid, in the world frame."""

    vertices: Float[ndarray, "V 3"]
    faces: ndarray
    """[F, 3] indices of vertices, counterclockwise seen from outside."""
    normals: Float[ndarray, "V 3"]
    """Unit length, outwards."""
    threshold: float
    """Opacity of a cell at the surface."""
    floaters: int
    """Pieces left out."""


def compute_otsu_threshold(values: Float[ndarray, "N"]) -> float:
    """The value from which on something is solid: the upper threshold that parts values into three groups, haze, blurred
    sides and solids, of the least variance within (Otsu 1979, section IV); 0.5 for no values at all.

    Two groups would do for a clean field. With much haze, the threshold between two groups lies within the haze.
    """
    from skimage.filters import threshold_multiotsu

    if not len(values):
        return 0.5
    low, high = float(values.min()), float(values.max())
    if len(np.flatnonzero(np.histogram(values, HISTOGRAM_BINS)[0])) < 3:
        return (low + high) / 2 if low < high else high / 2
    # It names the middle of a bin, all of which belongs below.
    found = threshold_multiotsu(values, 3, HISTOGRAM_BINS)[1] + (high - low) / HISTOGRAM_BINS / 2
    # Between two clear groups many thresholds are as good: the middle one.
    above = values > found
    return float(values[~above].max() + values[above].min()) / 2


@torch.no_grad()
def find_unoccluded_cells(system: NeRF3D, volume: Volume, cameras: Cameras) -> Bool[ndarray, "X Y Z"]:
    """Cells that at least one view sees, up to the surface it renders there; all others are inside something.

    Args:
        system: the field that the volume was sampled from.
        volume: whose cells are tested.
        cameras: the views it was trained from.
    """
    places = volume.centres.view(-1, 3)
    dark = torch.arange(len(places))
    cameras = cameras.rescale(min(1.0, MAX_VISIBILITY_SIDE / cameras.max_side))
    # Within a pixel a slanted surface has many depths: where cells are finer, the pixel's width says how far to go on.
    beyond = max(volume.cell, CELL_WIDTH_PIXELS * cameras.pixel_footprint(system.field.bounds.centre.cpu()))
    for view in track_progress(range(len(cameras)), len(cameras), "views"):
        rendered = system.render(cameras.generate_view_rays(view).to(system.device))
        ends = torch.where(rendered.opacity > 0.5, rendered.depth, MISS_DISTANCE).cpu() + beyond
        # At an outline a pixel's depth is a mean of near and far: the nearest of its neighbours' counts.
        width, height = cameras.size(view)
        ends = -torch.nn.functional.max_pool2d(-ends.view(1, height, width), 3, 1, 1).flatten()
        pixels, _, seen = cameras.project(places[dark], view)
        col, row = torch.where(seen[:, None], pixels, 0.0).long().unbind(1)
        reach = torch.where(seen, ends[row * width + col], 0.0)
        dark = dark[(places[dark] - cameras.centres[view]).norm(dim=1) > reach]
    unoccluded = torch.ones(len(places), dtype=torch.bool)
    unoccluded[dark] = False
    return unoccluded.view(volume.density.shape).numpy()


def fill_bounding_box(mask: Bool[ndarray, "X Y Z"]) -> Bool[ndarray, "X Y Z"]:
    """The cells of the smallest box that holds all marked ones: what is unlit beyond it, such as below a floor, is not inside
    anything."""
    box = np.zeros(mask.shape, bool)
    for place in ndimage.find_objects(mask.astype(int)):
        box[place] = True
    return box


def extract_surface(volume: Volume, unoccluded: Bool[ndarray, "X Y Z"], threshold: float | None = None) -> Surface:
    """The surface of what is dense or in the dark, by marching cubes (Lewiner et al. 2003).

    Args:
        volume: densities.
        unoccluded: see `find_unoccluded_cells`; cells that are not lit count as solid.
        threshold: opacity of a cell at the surface, in (0, 1); None finds it from the histogram of cells in the light.

    Raises:
        InputError: where nothing is as dense as that.
    """
    from skimage.measure import marching_cubes

    level = volume.opacity.numpy()
    if threshold is None:
        threshold = compute_otsu_threshold(level[unoccluded & (level > MIN_CELL_OPACITY)])
    most = level.max()
    level = np.where(unoccluded | ~fill_bounding_box(unoccluded & (level > threshold)), level, 1.0)
    pieces, _ = ndimage.label(level > threshold, structure=np.ones((3, 3, 3)))
    if not most > threshold:
        found, expected = f"nothing above an opacity of {threshold:.2f} a cell", f"at most {most:.2f}"
        raise InputError("export", "threshold", found, expected, "train longer, or lower --threshold")
    sizes = np.bincount(pieces.ravel())[1:]
    floating = np.flatnonzero(sizes < MAX_FLOATER_FRACTION * sizes.max()) + 1
    # A margin closes the box's sides; pieces that float go, with the haze around them.
    gone = np.isin(pieces, floating)
    level[ndimage.binary_dilation(gone, np.ones((3, 3, 3))) & (gone | (pieces == 0))] = 0
    vertices, faces, normals, _ = marching_cubes(np.pad(level, 1), threshold)
    places = volume.index_to_world(torch.from_numpy(vertices - 1).float()).numpy()
    return Surface(places, faces[:, ::-1].copy(), normals.astype(np.float32), float(threshold), len(floating))
