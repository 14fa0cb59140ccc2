"""The hot loops: each file holds a plain PyTorch reference for every device, and picks between it and a fast version.

The fast versions for CPUs are in `cpu/`; `use_kernels("reference")` (config key `kernels`) switches them all off.
"""

from nerf_lightning.kernels.composite import composite, keep_visible, volume_weights
from nerf_lightning.kernels.front_first import front_first
from nerf_lightning.kernels.harmonics import spherical_harmonics
from nerf_lightning.kernels.hashgrid import hash_interpolate
from nerf_lightning.kernels.march import cell_index, march, mark_cells, pack_intervals, points
from nerf_lightning.kernels.merge import merge_faint
from nerf_lightning.kernels.mlp import mlp, mlp_heads
from nerf_lightning.kernels.planes import plane_line_products, plane_line_sum
from nerf_lightning.kernels.proposals import along, inverse_cdf, resample
from nerf_lightning.kernels.switch import has_fast, use_kernels
from nerf_lightning.kernels.voxels import interpolate_rows, locate, mark_rows, read_voxels, roughness, voxel_value

__all__ = [
    "along",
    "cell_index",
    "composite",
    "front_first",
    "has_fast",
    "hash_interpolate",
    "interpolate_rows",
    "inverse_cdf",
    "keep_visible",
    "locate",
    "march",
    "mark_cells",
    "mark_rows",
    "merge_faint",
    "mlp",
    "mlp_heads",
    "pack_intervals",
    "plane_line_products",
    "plane_line_sum",
    "points",
    "read_voxels",
    "resample",
    "roughness",
    "spherical_harmonics",
    "use_kernels",
    "volume_weights",
    "voxel_value",
]
