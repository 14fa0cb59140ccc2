"""From densities to a surface: where a solid begins, without what floats and without what nobody can see inside it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage

from nerf_lightning.errors import InputError
from nerf_lightning.export.volume import Volume

BINS = 128
EMPTY = 0.02
"""Opacity of a cell below which it is nothing at all, and says nothing about where to draw the line."""
FLOATER = 0.01
"""A piece with fewer cells than this share of the largest one's floats, and is left out."""


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


def otsu(values: Float[ndarray, "N"]) -> float:
    """The threshold in [0, 1] that parts values into two groups of the least variance within (Otsu 1979); 0.5 for too few."""
    counts, edges = np.histogram(values, BINS, (0.0, 1.0))
    centres = (edges[:-1] + edges[1:]) / 2
    below, total = np.cumsum(counts), counts.sum()
    above = total - below
    sums = np.cumsum(counts * centres)
    with np.errstate(divide="ignore", invalid="ignore"):
        apart = below * above * (sums / below - (sums[-1] - sums) / above) ** 2
    if not np.isfinite(apart).any():
        return 0.5
    best = np.nan_to_num(apart, nan=-1.0)
    # Between two clear groups many thresholds are as good: the middle one.
    return float(edges[1:][np.flatnonzero(best >= best.max() * (1 - 1e-9))].mean())


def solid_of(opacity: Float[ndarray, "X Y Z"], threshold: float) -> tuple[Bool[ndarray, "X Y Z"], int]:
    """Which cells are solid, and how many floating pieces were left out; what is enclosed counts as solid."""
    pieces, count = ndimage.label(opacity > threshold, structure=np.ones((3, 3, 3)))
    if not count:
        return np.zeros(opacity.shape, bool), 0
    sizes = np.bincount(pieces.ravel())[1:]
    large = np.flatnonzero(sizes >= FLOATER * sizes.max()) + 1
    return ndimage.binary_fill_holes(np.isin(pieces, large)), count - len(large)


def find_surface(volume: Volume, threshold: float | None = None) -> Surface:
    """The surface of what is dense, by marching cubes (Lewiner et al. 2003).

    Args:
        volume: densities.
        threshold: opacity of a cell at the surface, in (0, 1); None finds it from the histogram.

    Raises:
        InputError: where nothing is as dense as that, or the threshold is none.
    """
    from skimage.measure import marching_cubes

    opacity = volume.opacity.numpy()
    if threshold is None:
        threshold = otsu(opacity[opacity > EMPTY])
    if not 0 < threshold < 1:
        raise InputError("config", "threshold", str(threshold), "between 0 and 1")
    solid, floaters = solid_of(opacity, threshold)
    if not solid.any():
        found = f"nothing above an opacity of {threshold:.2f} a cell"
        raise InputError(
            "config", "threshold", found, f"at most {opacity.max():.2f}", "train longer, or lower threshold"
        )
    # Pieces left out are empty, also around what stays of them; what is enclosed is full. A margin closes the box's sides.
    near = ndimage.binary_dilation(solid, np.ones((3, 3, 3)))
    inner = ndimage.binary_erosion(solid, np.ones((3, 3, 3)))
    level = np.where(near, opacity, 0.0)
    level[solid] = np.maximum(level[solid], threshold + 1e-3 * (1 - threshold))
    level[inner] = 1.0
    vertices, faces, normals, _ = marching_cubes(np.pad(level, 1), threshold)
    places = volume.places(torch.from_numpy(vertices - 1).float()).numpy()
    return Surface(places, faces[:, ::-1].copy(), normals.astype(np.float32), float(threshold), floaters)
