"""Builds a scene from registered photos: undistorted, resized, split, with bounds and an orbit."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8

from nerf_lightning.cameras import Bounds, Cameras
from nerf_lightning.cameras.paths import make_orbit_path
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.region import find_region
from nerf_lightning.dataset.resize import fit_size
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.scene_bounds import estimate_visible_cube
from nerf_lightning.dataset.scene_builder import NEAR_FRACTION
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError

SUBJECT_WIDTH_FRACTION = 0.5
"""Width of the box relative to the width that photos show at the subject; tags may lie outside, in the contracted part."""


def undistort_photos(
    paths: Sequence[Path], lens: Intrinsics, width: int, height: int
) -> tuple[UInt8[np.ndarray, "V h w 3"], Float[np.ndarray, "3 3"]]:
    """Undistorts photos and downsamples them to a size; also returns K of the full-size pinhole camera.

    The pinhole camera zooms in just enough that every pixel has a source.
    """
    size, distortion = (lens.width, lens.height), lens.opencv_distortion
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV puts pixel centers at integers, we put them at +0.5
    pinhole = lens.K - half
    if distortion.any():
        pinhole, _ = cv2.getOptimalNewCameraMatrix(pinhole, distortion, size, 0, size)
    col, row = cv2.initUndistortRectifyMap(lens.K - half, distortion, None, pinhole, size, cv2.CV_32FC1)
    photos = []
    for path in paths:
        image = np.ascontiguousarray(read_pixels(path, upright=True)[..., :3])
        # Replicated borders keep rounding from turning edge pixels black.
        image = cv2.remap(image, col, row, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        photos.append(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA))
    return np.stack(photos), pinhole + half


def build_scene(
    paths: Sequence[Path],
    c2w: Float[np.ndarray, "V 4 4"],
    lens: Intrinsics,
    name: str,
    source: str,
    max_side: int | None = 300,
    holdout: int = 10,
) -> Scene:
    """Builds an unbounded scene from registered photos.

    The scene's frame is that of the tags: meters, z out of the paper. The box is a cube around the point that the cameras
    look at, half as wide as the photos show there.

    Args:
        paths: the photos, all of the lens's size.
        c2w: camera to world, OpenCV frame, meters.
        lens: intrinsics of the photos.
        name, source: see `Scene`.
        max_side: side of the scene's photos in pixels; None keeps their size.
        holdout: every N-th photo is held out.

    Raises:
        InputError: fewer than two photos.
    """
    if len(paths) < 2:
        raise InputError(source, "", f"{len(paths)} registered photos", "at least 2: one to train on, one to hold out")
    width, height = fit_size(lens.width, lens.height, max_side)
    photos, pinhole = undistort_photos(paths, lens, width, height)
    images, K = torch.from_numpy(photos), torch.from_numpy(pinhole).float().repeat(len(paths), 1, 1)
    cameras = Cameras.pinhole(K, torch.from_numpy(c2w).float(), lens.width, lens.height).resize((width, height))
    is_val = torch.zeros(len(paths), dtype=torch.bool)
    is_val[holdout // 2 :: holdout] = True
    if not is_val.any():
        is_val[len(paths) // 2] = True
    train = Views.from_images(images[~is_val], cameras[~is_val])
    region = find_region(train.cameras.c2w)
    center = region.center.float()
    nearest = float((train.cameras.centers - center).norm(dim=1).min())
    aabb = center + SUBJECT_WIDTH_FRACTION * (torch.from_numpy(estimate_visible_cube(train.cameras)).float() - center)
    return Scene(
        name=name,
        source=source,
        train=train,
        val=Views.from_images(images[is_val], cameras[is_val]),
        orbit=make_orbit_path(train.cameras, region.layout, center),
        bounds=Bounds(aabb, unbounded=True, near=NEAR_FRACTION * min(region.unit, nearest)),
    )
