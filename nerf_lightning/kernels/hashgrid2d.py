"""Bilinear interpolation on nested grids with hashed entries: `hashgrid` in two dimensions (Instant-NGP, section 3)."""

from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.hashgrid import HashInterpolate, hash_interpolate_reference
from nerf_lightning.kernels.switch import fast

Resolution = tuple[int, int]
"""Cells of a level along x and along y."""


def hash_interpolate_2d(
    tables: Float[Tensor, "T F"], unit: Float[Tensor, "N 2"], resolutions: list[Resolution], sizes: list[int]
) -> Float[Tensor, "N LF"]:
    """Bilinear interpolation at every level, features side by side.

    Args:
        tables: the levels' entries, one level after the other.
        unit: places in [0, 1]^2; outside they are clamped.
        resolutions: cells along x and y, a level.
        sizes: entries of each level's table: all corners of its grid, or a power of two to hash into.
    """
    if fast(tables, unit) and not unit.requires_grad:
        return HashInterpolate.apply(tables, unit, resolutions, sizes)
    return hash_interpolate_reference(tables, unit, resolutions, sizes)
