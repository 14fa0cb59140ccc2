"""Training resolution of photos, chosen by budget, device and memory; and area averaging to it."""

import itertools
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from nerf_lightning.dataset.formats.image_files import read_image_size
from nerf_lightning.dataset.orientation import has_same_aspect
from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.memory import free_memory

log = logging.getLogger(__name__)

AUTO: Literal["auto"] = "auto"
REFERENCE_LONGEST_PX, REFERENCE_CORE_SECONDS, SIZE_EXPONENT = 800, 360.0, 1 / 3
"""Longest side for 180 s on two cores, and the estimated exponent of its growth with the work, see `compute_auto_resize`."""
MIN_LONGEST_PX = 800
"""Smaller photos do not improve short trainings, and published results use this size."""
DEFAULT_TRAIN_SECONDS = 90.0
"""Training time assumed without a budget."""
CORE_SECONDS_PER_STEP = 0.06
"""Step time of the experiment `capture` on a CPU."""
ACCELERATOR_CORES = 64
"""CPU cores equivalent to an accelerator (estimate)."""
MAX_MEMORY_FRACTION = 0.4
"""Fraction of the free memory for photos."""
DOWNSCALE_FACTORS = (8, 4, 2)
"""Reduction factors of the photos in the folders `images_8`, `images_4`, `images_2`."""
MAX_PARENT_FOLDERS = 3
"""Parent folders of a photo that are searched for siblings with reduced copies."""


@dataclass(frozen=True)
class AutoResize:
    """Longest side in pixels for a training budget, see `compute_auto_resize`."""

    longest: int


def compute_auto_resize(seconds: float | None, steps: int | None, device: torch.device, threads: int) -> AutoResize:
    """Computes the training resolution for a budget in seconds or steps, whichever ends first; 90 s by default.

    The longest side is 800 * (work / 360) ** (1/3), at least MIN_LONGEST_PX; work is seconds times cores.
    On a phone capture of 1080x1920 (experiment `capture`, two cores, one seed, PSNR against full-size held-out photos), 60 s
    at longest sides of 480, 960 and 1920 pixels reached 28.07, 27.99 and 27.55 dB, 180 s at 480 and 960 reached 29.17 and
    29.06 dB: more pixels gain nothing so early, and slow down validation and rendering.
    """
    cores = threads if device.type == "cpu" else ACCELERATOR_CORES
    limits = [] if seconds is None else [seconds * cores]
    limits += [] if steps is None else [steps * CORE_SECONDS_PER_STEP]
    work = min(limits, default=DEFAULT_TRAIN_SECONDS * cores)
    longest = REFERENCE_LONGEST_PX * (work / REFERENCE_CORE_SECONDS) ** SIZE_EXPONENT
    return AutoResize(round(max(longest, MIN_LONGEST_PX)))


def choose_resize(
    source: object, sizes: Sequence[tuple[int, int]], channels: int, resize: int | str | AutoResize | None
) -> int | None:
    """Chooses the longest side to which photos are averaged; None keeps them. Logs an automatic choice.

    Automatic sizes divide the largest photo by an integer, so that output pixels average whole input pixels; the divisor
    grows until the photos fit into memory.

    Args:
        source: path given by the user, for the message.
        sizes: widths and heights.
        channels: bytes per pixel.
        resize: longest side, or how to choose it; "auto" assumes 90 s of training on this process's threads.

    Raises:
        InputError: invalid `resize`.
    """
    if resize == AUTO:
        resize = compute_auto_resize(None, None, CPU, torch.get_num_threads())
    if isinstance(resize, str) or (isinstance(resize, int) and resize < 1):
        raise InputError("config", "dataset.resize", repr(resize), "auto, null or the longest side in pixels")
    if not isinstance(resize, AutoResize):
        return resize
    width, height = max(sizes, key=max)
    largest = max(width, height)
    divisor = max(1, round(largest / resize.longest))
    pixels = MAX_MEMORY_FRACTION * free_memory() / channels
    while divisor < largest and sum(math.prod(fit_size(*size, round(largest / divisor))) for size in sizes) > pixels:
        divisor += 1
    if divisor == 1:
        return None
    longest = round(largest / divisor)
    text = "%s: photos of %dx%d resized to %dx%d to match budget and memory (dataset.resize=null keeps the size)"
    log.info(text, source, width, height, *fit_size(width, height, longest))
    return longest


def find_downscaled(photo: Path, size: tuple[int, int], upright: bool) -> Path:
    """Finds the smallest copy of a photo in `images_8`, `images_4` or `images_2` that is at least `size` and has the same
    aspect ratio and channels; else returns the photo."""
    width, height, alpha = read_image_size(photo, upright)
    parents = [folder for folder in photo.parents[:MAX_PARENT_FOLDERS] if folder.name]
    for factor, folder in itertools.product(DOWNSCALE_FACTORS, parents):
        file = folder.with_name(f"{folder.name}_{factor}") / photo.relative_to(folder)
        if file.is_file():
            w, h, has_alpha = read_image_size(file, upright)
            if w >= size[0] and h >= size[1] and has_same_aspect((w, h), (width, height)) and has_alpha == alpha:
                return file
    return photo


def fit_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Scales a size down to a longest side of `longest` pixels; never up, and not at all for None."""
    if longest is None:
        return width, height
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resize_area(image: UInt8[np.ndarray, "H W C"], width: int, height: int) -> UInt8[np.ndarray, "h w C"]:
    """Area-averages an image; RGBA with premultiplied alpha, since arbitrary colors under alpha 0 would give dark rims."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[2] == 3:
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    premultiplied = image.astype(np.float32)
    premultiplied[..., :3] *= premultiplied[..., 3:] / 255
    rgba = np.asarray(cv2.resize(premultiplied, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    rgba[..., :3] /= np.maximum(rgba[..., 3:] / 255, 1e-6)
    return np.rint(rgba).clip(0, 255).astype(np.uint8)
