"""Kernels: each file holds a PyTorch reference for every device and dispatches to the fast CPU version in `cpu/`.

`set_kernels("reference")` (config key `kernels`) disables all fast versions.
"""

from nerf_lightning.kernels.activation import truncated_exp
from nerf_lightning.kernels.backend import has_fast_kernel, set_kernels
from nerf_lightning.kernels.composite import composite, filter_visible, interval_weights, median_depth, volume_weights
from nerf_lightning.kernels.harmonics import spherical_harmonics
from nerf_lightning.kernels.hashgrid import hash_interpolate
from nerf_lightning.kernels.march import cell_index, march, mark_cells, pack_intervals, ray_positions
from nerf_lightning.kernels.march_until_opaque import march_until_opaque
from nerf_lightning.kernels.merge import merge_low_weight
from nerf_lightning.kernels.mlp import mlp, mlp_heads
from nerf_lightning.kernels.photometric import compare_colors, composite_over, photometric_loss
from nerf_lightning.kernels.proposals import interlevel_loss, proposal_weights
from nerf_lightning.kernels.resampling import interval_midpoints, invert_cdf, resample
from nerf_lightning.kernels.vector_matrix import plane_line_products, plane_line_sum, plane_line_sum_and_products
from nerf_lightning.kernels.voxels import (
    interpolate_rows,
    interpolate_scalar,
    interpolate_voxels,
    locate_vertices,
    mark_rows,
    total_variation,
)
from nerf_lightning.kernels.weight_losses import weight_losses

__all__ = [
    "median_depth",
    "interlevel_loss",
    "interval_midpoints",
    "interval_weights",
    "cell_index",
    "composite",
    "compare_colors",
    "composite_over",
    "march_until_opaque",
    "has_fast_kernel",
    "hash_interpolate",
    "interpolate_rows",
    "invert_cdf",
    "filter_visible",
    "locate_vertices",
    "march",
    "mark_cells",
    "mark_rows",
    "merge_low_weight",
    "mlp",
    "mlp_heads",
    "pack_intervals",
    "photometric_loss",
    "plane_line_products",
    "plane_line_sum",
    "plane_line_sum_and_products",
    "proposal_weights",
    "ray_positions",
    "interpolate_voxels",
    "resample",
    "total_variation",
    "truncated_exp",
    "spherical_harmonics",
    "set_kernels",
    "volume_weights",
    "weight_losses",
    "interpolate_scalar",
]
