"""Stage 1, cameras: pixels -> Rays, and the Bounds of the content along them."""

from nerf_lightning.cameras.bounds import Bounds, InBounds
from nerf_lightning.cameras.cameras import Cameras, Rays, has_panoramas
from nerf_lightning.cameras.layout import Layout, classify_layout
from nerf_lightning.cameras.lenses import Distortion, Lenses, Projection
from nerf_lightning.cameras.paths import orbit_like, pivot_of, resample_path, spiral_like
from nerf_lightning.cameras.poses import find_up, look_at, orbit_around, turn_upright, typical_view, upward
from nerf_lightning.cameras.transforms import in_other_frame, pixel_to_camera, transform, transform_directions

__all__ = [
    "Bounds",
    "Cameras",
    "Distortion",
    "InBounds",
    "Layout",
    "Lenses",
    "Projection",
    "Rays",
    "classify_layout",
    "find_up",
    "has_panoramas",
    "in_other_frame",
    "look_at",
    "orbit_around",
    "orbit_like",
    "pixel_to_camera",
    "pivot_of",
    "resample_path",
    "spiral_like",
    "transform",
    "transform_directions",
    "turn_upright",
    "typical_view",
    "upward",
]
