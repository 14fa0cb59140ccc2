"""Cameras: pixels -> Rays, and the Bounds of the scene along them."""

from nerf_lightning.cameras.bounds import BoundedModule, Bounds
from nerf_lightning.cameras.camera_layout import CameraLayout, classify_layout
from nerf_lightning.cameras.cameras import Cameras, Rays, has_panoramas
from nerf_lightning.cameras.lenses import Distortion, Lenses, Projection
from nerf_lightning.cameras.paths import find_pivot, make_orbit_path, make_spiral_path, resample_path, start_at_middle
from nerf_lightning.cameras.poses import (
    estimate_up,
    find_typical_view,
    look_at,
    make_circle_poses,
    mean_up,
    rotation_to_z_up,
)
from nerf_lightning.cameras.transforms import pixel_to_camera, transform_directions, transform_points, transform_poses

__all__ = [
    "Bounds",
    "Cameras",
    "Distortion",
    "BoundedModule",
    "CameraLayout",
    "Lenses",
    "Projection",
    "Rays",
    "classify_layout",
    "estimate_up",
    "has_panoramas",
    "transform_poses",
    "look_at",
    "make_circle_poses",
    "make_orbit_path",
    "pixel_to_camera",
    "find_pivot",
    "resample_path",
    "start_at_middle",
    "make_spiral_path",
    "transform_points",
    "transform_directions",
    "rotation_to_z_up",
    "find_typical_view",
    "mean_up",
]
