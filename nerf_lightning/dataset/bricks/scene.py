"""The built-in scene: a ray-traced bulldozer of bricks, so that a run needs no download."""

import math
import os
import warnings
import zipfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, look_at, orbit_around
from nerf_lightning.dataset.bricks.model import bulldozer
from nerf_lightning.dataset.bricks.trace import picture, shadow
from nerf_lightning.dataset.scene import BUILT_IN, Scene
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.utils.files import atomic, cache_folder
from nerf_lightning.utils.memory import check_memory

VERSION = 1
"""Part of the cache file's name: raise it whenever model, shading or cameras change."""
RADIUS = 4.0311
"""Distance of every camera from the origin, as in the NeRF paper's Lego scene."""
FIELD_OF_VIEW = 0.6911112
"""Horizontal, radians; from the same scene."""
ORBIT_ELEVATION = math.radians(30)
POSE = 116
"""Bytes of a pose, its intrinsics and size."""
UP = (0.0, 0.0, 1.0)


def bricks(
    size: int = 200, train_views: int = 100, val_views: int = 10, orbit_views: int = 60, cache: str | None = None
) -> Scene:
    """The bulldozer, seen by cameras like those of the NeRF paper's Lego scene; the same bytes on every run.

    Args:
        size: width and height of the pictures in pixels.
        train_views: how many views to train on, spread over the upper hemisphere.
        val_views: how many views to hold out, spread likewise, at other directions.
        orbit_views: how many frames the circle around it has.
        cache: folder that keeps the traced pictures; None for the user's cache folder, "" for none.
    """
    counts = {"size": size, "train_views": train_views, "val_views": val_views, "orbit_views": orbit_views}
    for key, value in counts.items():
        if value < 1:
            raise InputError("bricks", key, str(value), "a whole number of at least 1")
    views = train_views + val_views
    what = f"{views:,} pictures of {size:,}x{size:,} pixels, with a pose each,"
    check_memory("bricks", "size, train_views, val_views", what, views * (4 * size**2 + POSE) + POSE * orbit_views)
    train = _cameras(_hemisphere(torch.arange(1, train_views + 1)), size)
    val = _cameras(_hemisphere(-torch.arange(1, val_views + 1)), size)
    orbit = _cameras(orbit_around(torch.zeros(3), torch.tensor(UP), RADIUS, ORBIT_ELEVATION, orbit_views), size)

    folder = cache_folder() if cache is None else Path(cache) if cache else None
    path = folder / f"bricks-v{VERSION}-{size}px-{train_views}-{val_views}.npz" if folder else None
    images = _load(path, train, val) if path else None
    if images is None:
        images = _pictures(train), _pictures(val)
        if path:
            _save(path, *images)

    aabb = torch.from_numpy(bulldozer().aabb).float()
    centre = aabb.mean(0)
    return Scene(
        name="bricks",
        source=BUILT_IN,
        train=Views.of(torch.from_numpy(images[0]), train),
        val=Views.of(torch.from_numpy(images[1]), val),
        orbit=orbit,
        bounds=Bounds(centre + 1.02 * (aabb - centre)),
        background=(0.0, 0.0, 0.0),
    )


def _cameras(c2w: Float[Tensor, "V 4 4"], size: int) -> Cameras:
    focal = 0.5 * size / math.tan(0.5 * FIELD_OF_VIEW)
    K = torch.tensor([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])
    return Cameras.of_size(K.repeat(len(c2w), 1, 1), c2w, size, size)


def _hemisphere(index: Tensor) -> Float[Tensor, "V 4 4"]:
    """Poses on the upper hemisphere, evenly spread whatever their number; no two indices share one.

    The R2 sequence: multiples of 1/g^2 and 1/g modulo 1, with g^3 = g + 1, fill the unit square; equal areas of it map
    to equal areas of the sphere. The pole and the horizon are left out: there up is undefined, here the plate an edge.
    """
    g = 1.324717957244746
    a, b = ((0.5 + index.double() / g**k) % 1 for k in (2, 1))
    z, azimuth = 0.03 + 0.94 * a, 2 * math.pi * b
    ring = (1 - z**2).sqrt()
    eye = RADIUS * torch.stack([ring * azimuth.cos(), ring * azimuth.sin(), z], dim=-1)
    return look_at(eye, torch.zeros(3).double(), torch.tensor(UP).double()).float()


def _pictures(cameras: Cameras) -> UInt8[np.ndarray, "V H W 4"]:
    shadow()  # made once, before the threads ask for it
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        return np.stack(list(pool.map(lambda view: picture(cameras, view), range(len(cameras)))))


def _load(path: Path, train: Cameras, val: Cameras) -> tuple[np.ndarray, np.ndarray] | None:
    """The pictures a file holds, or None where there is none or it is not whole: they can be traced again."""
    try:
        with path.open("rb") as opened, np.load(opened) as file:
            images = file["images_train"], file["images_val"]
    except (OSError, ValueError, LookupError, EOFError, zipfile.BadZipFile, zlib.error):
        return None
    wanted = [(len(cameras), cameras.height, cameras.width, 4) for cameras in (train, val)]
    return images if [image.shape for image in images] == wanted else None


def _save(path: Path, train: np.ndarray, val: np.ndarray) -> None:
    """Writes a whole file or none; where the folder cannot be written, says so and goes on."""
    try:
        with atomic(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, images_train=train, images_val=val)
    except (OSError, NoRoom) as error:
        warnings.warn(f"the built-in scene is not cached, the next run traces it again: {error}", stacklevel=3)
