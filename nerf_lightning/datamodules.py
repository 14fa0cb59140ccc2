"""Builders of data modules, the Hydra targets of `conf/dataset`."""

import logging
import os
import shutil
import urllib.request
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import torch
from jaxtyping import UInt8
from torch import Tensor

from nerf_lightning.dataset.photo_loading import MaskMeaning, Orientation, PhotoLoadOptions
from nerf_lightning.dataset.picture import load_picture, make_builtin_picture
from nerf_lightning.dataset.pixel_datamodule import Picture, PixelDataModule
from nerf_lightning.dataset.ray_datamodule import (
    DEFAULT_ERROR_SAMPLING,
    DEFAULT_RAYS,
    DEFAULT_SAMPLES,
    ErrorSampling,
    RayDataModule,
)
from nerf_lightning.dataset.resize import AUTO, AutoResize, fit_size, resize_area
from nerf_lightning.dataset.scene import BUILT_IN
from nerf_lightning.dataset.scene_reader import open_scene
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.utils.files import atomic_write, expand_user_path
from nerf_lightning.utils.option_checks import Count, Ge

log = logging.getLogger(__name__)

TIMEOUT_SECONDS = 10.0


def build_photo_data(
    path: str | None = None,
    name: str | None = None,
    resize: Count | Literal["auto"] | AutoResize | None = AUTO,
    holdout: Annotated[int, Ge(2)] = 8,
    masked: MaskMeaning = "auto",
    invert_masks: bool = False,
    bounded: bool | Literal["auto"] = "auto",
    orientation: Orientation = "auto",
    near: float | None = None,
    far: float | None = None,
    rays: Count = DEFAULT_RAYS,
    samples: Count | None = DEFAULT_SAMPLES,
    seed: int = 0,
    error_sampling: ErrorSampling = DEFAULT_ERROR_SAMPLING,
    url: str | None = None,
    folder: str = "data",
    download: bool = True,
) -> RayDataModule:
    """Builds a data module of posed photos, or of a published scene; the built-in one if the download fails.

    Args:
        path, name, near, far: see `open_scene`.
        resize, holdout, masked, invert_masks, bounded, orientation: see `PhotoLoadOptions`.
        rays, samples, seed, error_sampling: see `RayDataModule`.
        url: address of a published .npz file, used without `path`.
        folder: where to store downloads.
        download: whether to use the network.

    Raises:
        InputError: neither path nor url, or an unreadable scene.
    """
    if path is None:
        if url is None:
            raise InputError("config", "dataset.path", "missing", hint="give the path of photos or a scene")
        path = fetch_published(url, Path(folder), download)
    if path is None:
        size = resize if isinstance(resize, int) else 200
        return build_bricks_data(size, rays=rays, samples=samples, seed=seed, error_sampling=error_sampling)
    kind = bounded if isinstance(bounded, str) else "true" if bounded else "false"
    options = PhotoLoadOptions(resize, holdout, masked, invert_masks, kind, orientation)
    return RayDataModule(open_scene(path, name, options, near, far), rays, samples, seed, error_sampling)


def fetch_published(url: str, folder: Path, download: bool) -> str | None:
    """Returns the local path of a published file, downloading it if needed; None, with a warning, if that fails."""
    local = folder / url.rsplit("/", 1)[-1]
    if local.exists():
        return str(local)
    problem = f"{local} does not exist"
    if download:
        try:
            _download(url, local)
            return str(local)
        except OSError as error:
            problem += f" and downloading {url} failed ({error})"
    log.warning("%s: using the built-in scene 'bricks' instead", problem)
    return None


def build_bricks_data(
    size: Count = 200,
    train_views: Count = 100,
    val_views: Count = 10,
    rays: Count = DEFAULT_RAYS,
    samples: Count | None = DEFAULT_SAMPLES,
    seed: int = 0,
    error_sampling: ErrorSampling = DEFAULT_ERROR_SAMPLING,
) -> RayDataModule:
    """Builds the data module of the built-in scene, see `bricks` and `RayDataModule`."""
    return RayDataModule(bricks(size, train_views, val_views), rays, samples, seed, error_sampling)


def _download(url: str, target: Path) -> None:
    request = urllib.request.Request(url, headers={"User-Agent": "nerf_lightning"})
    with urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS) as response, atomic_write(target) as temporary:
        with temporary.open("wb") as file:
            shutil.copyfileobj(response, file)
        expected = response.headers.get("Content-Length")
        if expected is not None and temporary.stat().st_size != int(expected):
            raise OSError(f"got {temporary.stat().st_size} of {expected} bytes")


def build_picture_data(
    path: str | None = None, max_side: Count | None = None, pixels: Count | None = None, seed: int = 0
) -> PixelDataModule:
    """Builds the data module of a picture from a file, or of the built-in one, see `load_picture`.

    Args:
        path: image file; None for the built-in picture.
        max_side: longest side in pixels, to which a larger picture is averaged; size of the built-in one.
        pixels, seed: see `PixelDataModule`.
    """
    if path is None:
        # Procedural: available at any size.
        image = make_builtin_picture(max_side or 256)
        picture = Picture("sunset", BUILT_IN, image, lambda width, _: make_builtin_picture(width))
    else:
        source = expand_user_path(path)
        original = load_picture(source)
        height, width = original.shape[:2]
        image = torch.from_numpy(resize_area(original.numpy(), *fit_size(width, height, max_side)))
        picture = Picture(source.stem.lower(), os.fspath(source), image, partial(downscale_picture, original))
    return PixelDataModule(picture, pixels, seed)


def downscale_picture(original: UInt8[Tensor, "H W 3"], width: int, height: int) -> UInt8[Tensor, "h w 3"] | None:
    """Averages a picture down to a size; None if it is smaller itself (by more than one pixel of rounding)."""
    if width > original.shape[1] + 1 or height > original.shape[0] + 1:
        return None
    return torch.from_numpy(resize_area(original.numpy(), width, height))
