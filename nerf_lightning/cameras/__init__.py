"""Stage 1, cameras: pixels -> Rays, and the Bounds of the content along them."""

from nerf_lightning.cameras.bounds import Bounds, InBounds
from nerf_lightning.cameras.cameras import Cameras, Rays
from nerf_lightning.cameras.orbit import focus_point, look_at, orbit_around, orbit_like, spiral_like
from nerf_lightning.cameras.transforms import pixel_to_camera, pixel_to_ray, transform, transform_directions

__all__ = [
    "Bounds",
    "Cameras",
    "InBounds",
    "Rays",
    "focus_point",
    "look_at",
    "orbit_around",
    "orbit_like",
    "pixel_to_camera",
    "pixel_to_ray",
    "spiral_like",
    "transform",
    "transform_directions",
]
