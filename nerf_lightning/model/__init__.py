"""Stage 4, fields: position and direction -> density and rgb; also pictures as fields of two coordinates."""

from nerf_lightning.kernels import truncated_exp
from nerf_lightning.model.field import Field, FieldOutput, PictureField
from nerf_lightning.model.growth import ResolutionSchedule
from nerf_lightning.model.hashgrid import HashGrid, HashGridField
from nerf_lightning.model.hashgrid2d import HashGrid2DField
from nerf_lightning.model.layers.activation import SoftenableReLU, density_activation
from nerf_lightning.model.layers.encoding import sinusoidal
from nerf_lightning.model.layers.networks import is_at_least_as_wide
from nerf_lightning.model.mlp import MLPField
from nerf_lightning.model.picture import FourierField, PictureMLP, SirenField
from nerf_lightning.model.tensorf import TensoRFField, VectorMatrix
from nerf_lightning.model.voxels import VoxelField

__all__ = [
    "Field",
    "FieldOutput",
    "FourierField",
    "HashGrid",
    "HashGrid2DField",
    "HashGridField",
    "MLPField",
    "PictureField",
    "PictureMLP",
    "SoftenableReLU",
    "ResolutionSchedule",
    "SirenField",
    "TensoRFField",
    "VectorMatrix",
    "VoxelField",
    "is_at_least_as_wide",
    "density_activation",
    "sinusoidal",
    "truncated_exp",
]
