"""The hot loops: each file holds a plain-torch reference, for every device, and the choice between it and a fast version.

Fast versions for CPUs stand in `cpu/`; `use_kernels("reference")` (config key `kernels`) switches them all off.
"""

from nerf_lightning.kernels.composite import (
    accumulate,
    composite,
    composite_reference,
    keep_visible,
    keep_visible_reference,
    volume_weights,
)
from nerf_lightning.kernels.harmonics import spherical_harmonics, spherical_harmonics_reference
from nerf_lightning.kernels.hashgrid import hash_interpolate, hash_interpolate_reference
from nerf_lightning.kernels.march import (
    cell_index,
    march,
    march_reference,
    mark_cells,
    mark_cells_reference,
    pack_intervals,
    points,
    points_reference,
)
from nerf_lightning.kernels.mlp import mlp, mlp_heads, mlp_reference
from nerf_lightning.kernels.planes import (
    plane_line_products,
    plane_line_products_reference,
    plane_line_sum,
    plane_line_sum_and_products,
)
from nerf_lightning.kernels.switch import fast, use_kernels
from nerf_lightning.kernels.voxels import (
    interpolate_rows,
    locate,
    locate_reference,
    mark_rows,
    read_voxels,
    read_voxels_reference,
    roughness,
    roughness_reference,
    voxel_value,
)

__all__ = [
    "accumulate",
    "cell_index",
    "composite",
    "composite_reference",
    "fast",
    "hash_interpolate",
    "hash_interpolate_reference",
    "interpolate_rows",
    "keep_visible",
    "keep_visible_reference",
    "locate",
    "locate_reference",
    "march",
    "march_reference",
    "mark_cells",
    "mark_cells_reference",
    "mark_rows",
    "mlp",
    "mlp_heads",
    "mlp_reference",
    "pack_intervals",
    "plane_line_products",
    "plane_line_products_reference",
    "plane_line_sum",
    "plane_line_sum_and_products",
    "points",
    "points_reference",
    "read_voxels",
    "read_voxels_reference",
    "roughness",
    "roughness_reference",
    "spherical_harmonics",
    "spherical_harmonics_reference",
    "use_kernels",
    "volume_weights",
    "voxel_value",
]
