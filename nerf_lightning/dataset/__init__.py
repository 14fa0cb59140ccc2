"""Stage 2, dataset: loads photos and poses of any format into a Scene."""

from nerf_lightning.dataset.formats.npz import load_npz, save_npz
from nerf_lightning.dataset.formats.transforms import load_blender, load_transforms
from nerf_lightning.dataset.photo_loading import PhotoLoadOptions
from nerf_lightning.dataset.picture import load_picture, make_builtin_picture
from nerf_lightning.dataset.pixel_datamodule import Picture, PictureBatch, PixelBatch, PixelDataModule, pixel_grid
from nerf_lightning.dataset.ray_datamodule import RayBatch, RayDataModule, ViewBatch
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.scene_bounds import estimate_bounds
from nerf_lightning.dataset.scene_reader import open_scene
from nerf_lightning.dataset.views import Views

DataModule = RayDataModule | PixelDataModule
"""For a scene (3D) or a picture (2D)."""

__all__ = [
    "BUILT_IN",
    "DataModule",
    "Picture",
    "PictureBatch",
    "PixelBatch",
    "PixelDataModule",
    "RayBatch",
    "PhotoLoadOptions",
    "RayDataModule",
    "ViewBatch",
    "Scene",
    "Views",
    "make_builtin_picture",
    "estimate_bounds",
    "load_blender",
    "load_transforms",
    "load_npz",
    "load_picture",
    "pixel_grid",
    "open_scene",
    "save_npz",
]
