"""The built-in scene: a ray-traced bulldozer of bricks, available without a download."""

import logging
import math
from contextlib import suppress

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, look_at, make_circle_poses
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.objects import make_pinhole_cameras
from nerf_lightning.synthetic.solids import load_bulldozer
from nerf_lightning.synthetic.tracer import render_view
from nerf_lightning.utils.files import atomic_write, cache_folder
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import read_npz

log = logging.getLogger(__name__)

CACHE_VERSION = 1
"""Version in the cache's file names: increment it when model, shading or cameras change."""
CAMERA_RADIUS, FIELD_OF_VIEW_RAD = 4.0311, 0.6911112
"""Distance of the cameras from the origin, and their horizontal field of view, as in NeRF's Lego scene."""
UP = (0.0, 0.0, 1.0)


def bricks(size: int = 200, train_views: int = 100, val_views: int = 10, orbit_views: int = 60) -> Scene:
    """The bulldozer scene, with cameras like those of NeRF's Lego scene; identical bytes on every run.

    Args:
        size: width and height of the images in pixels.
        train_views: number of training views, spread over the upper hemisphere.
        val_views: number of held-out views, spread likewise, at other directions.
        orbit_views: number of frames of the orbit.
    """
    contents = f"{train_views + val_views:,} pictures of {size:,}x{size:,} pixels"
    check_memory("bricks", "size, train_views, val_views", contents, 4.0 * size**2 * (train_views + val_views))
    aabb = torch.from_numpy(load_bulldozer().aabb).float()
    center = aabb.mean(0)
    orbit = make_circle_poses(torch.zeros(3), torch.tensor(UP), CAMERA_RADIUS, math.radians(30), orbit_views)
    return Scene(
        name="bricks",
        source=BUILT_IN,
        train=_render_views(_hemisphere_poses(torch.arange(1, train_views + 1)), size, "train"),
        val=_render_views(_hemisphere_poses(-torch.arange(1, val_views + 1)), size, "val"),
        orbit=make_pinhole_cameras(orbit, size, size, FIELD_OF_VIEW_RAD),
        bounds=Bounds(center + 1.02 * (aabb - center)),
        background=(0.0, 0.0, 0.0),
    )


def _render_views(c2w: Float[Tensor, "V 4 4"], size: int, split: str) -> Views:
    """Renders views of the bulldozer, or reads them from the cache."""
    cameras = make_pinhole_cameras(c2w, size, size, FIELD_OF_VIEW_RAD)
    path = cache_folder() / f"bricks-v{CACHE_VERSION}-{size}px-{len(cameras)}-{split}.npz"
    with suppress(InputError, KeyError):  # missing or damaged: render again
        images = read_npz(path, ["images"])["images"]
        if images.shape == (len(cameras), size, size, 4) and images.dtype == np.uint8:
            return Views.from_images(torch.from_numpy(images), cameras)
    images = np.stack([render_view(cameras, view) for view in range(len(cameras))])
    try:
        with atomic_write(path) as temporary:
            np.savez_compressed(temporary, images=images)
    except (OSError, InputError) as error:
        log.warning("cannot cache the built-in scene, the next run renders it again: %s", error)
    return Views.from_images(torch.from_numpy(images), cameras)


def _hemisphere_poses(index: Tensor) -> Float[Tensor, "V 4 4"]:
    """Low-discrepancy poses on the upper hemisphere, distinct for distinct indices.

    The R2 sequence: multiples of 1/g^2 and 1/g modulo 1, with g^3 = g + 1, fill the unit square, which maps to the sphere
    with equal areas. The pole, where up is undefined, and the horizon, which sees the plate edge-on, are excluded.
    """
    g = 1.324717957244746
    a, b = ((0.5 + index.double() / g**k) % 1 for k in (2, 1))
    z, azimuth = 0.03 + 0.94 * a, 2 * math.pi * b
    ring = (1 - z**2).sqrt()
    eye = CAMERA_RADIUS * torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], dim=-1)
    return look_at(eye, torch.zeros(3).double(), torch.tensor(UP).double()).float()
