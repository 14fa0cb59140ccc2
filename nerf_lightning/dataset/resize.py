"""The size at which photos are trained on, by what budget, device and memory can use; and area averages to it."""

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
"""What 180 s on two cores use, see `compute_auto_resize`, and how the longest side grows with the work (an estimate)."""
MIN_LONGEST_PX = 800
"""Smaller photos make no shorter training better, and at this size the field publishes."""
DEFAULT_TRAIN_SECONDS = 90.0
"""Of training, where nobody says."""
CORE_SECONDS_PER_STEP = 0.06
"""Of the experiment `capture` on a CPU."""
ACCELERATOR_CORES = 64
"""Cores that an accelerator stands for; an estimate."""
MAX_MEMORY_FRACTION = 0.4
"""Of the free memory that photos may take."""
DOWNSCALE_FACTORS = (8, 4, 2)
"""Folders `images_8`, `images_4`, `images_2` hold the same photos at these fractions of their size."""
MAX_PARENT_FOLDERS = 3
"""Folders above a photo that may be the one with reduced copies beside it."""


@dataclass(frozen=True)
class AutoResize:
    """The longest side in pixels that suits a training, see `compute_auto_resize`."""

    longest: int


def compute_auto_resize(seconds: float | None, steps: int | None, device: torch.device, threads: int) -> AutoResize:
    """The size for a training of so many seconds or steps, whichever ends first; for one of 90 s where neither is given.

    The longest side is 800 * (work / 360) ** (1/3), at least MIN_LONGEST_PX; work is seconds times cores.
    On a phone capture of 1080x1920 (experiment `capture`, two cores, one seed, PSNR against held-out photos of full size),
    trainings of 60 s at longest sides of 480, 960 and 1920 pixels reached 28.07, 27.99 and 27.55 dB, those of 180 s at 480 and
    960 reached 29.17 and 29.06 dB: more pixels bring nothing so early, and views of them take longer to measure and to draw.
    """
    cores = threads if device.type == "cpu" else ACCELERATOR_CORES
    limits = [] if seconds is None else [seconds * cores]
    limits += [] if steps is None else [steps * CORE_SECONDS_PER_STEP]
    work = min(limits, default=DEFAULT_TRAIN_SECONDS * cores)
    return AutoResize(
        round(max(REFERENCE_LONGEST_PX * (work / REFERENCE_CORE_SECONDS) ** SIZE_EXPONENT, MIN_LONGEST_PX))
    )


def choose_resize(
    source: object, sizes: Sequence[tuple[int, int]], channels: int, resize: int | str | AutoResize | None
) -> int | None:
    """The longest side that photos of these sizes are read at; None keeps them. Tells what was chosen.

    The largest photo is divided by the whole number that comes nearest to the size that suits, so that pixels are means of
    whole ones where it divides the sides; a larger one where the memory has no room.

    Args:
        source: what the user named, for the message.
        sizes: widths and heights.
        channels: bytes a pixel.
        resize: longest side, or what chooses it; `auto` is for a training of 90 s on this process's threads.

    Raises:
        InputError: for a `resize` that is nothing of these.
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
    text = "%s: photos of %dx%d are read at %dx%d, what budget and memory can use; dataset.resize=null keeps the size"
    log.info(text, source, width, height, *fit_size(width, height, longest))
    return longest


def find_downscaled(photo: Path, size: tuple[int, int], upright: bool) -> Path:
    """The same photo in `images_8`, `images_4` or `images_2` beside its folder `images`, where that is large enough for `size`
    and has the same shape and channels; else the photo itself."""
    width, height, alpha = read_image_size(photo, upright)
    above = [folder for folder in photo.parents[:MAX_PARENT_FOLDERS] if folder.name]
    for factor, folder in itertools.product(DOWNSCALE_FACTORS, above):
        file = folder.with_name(f"{folder.name}_{factor}") / photo.relative_to(folder)
        if file.is_file():
            w, h, has_alpha = read_image_size(file, upright)
            if w >= size[0] and h >= size[1] and has_same_aspect((w, h), (width, height)) and has_alpha == alpha:
                return file
    return photo


def fit_size(width: int, height: int, longest: int | None) -> tuple[int, int]:
    """Width and height with the longest side at `longest` pixels; never larger than before, and as before for None."""
    if longest is None:
        return width, height
    scale = min(1.0, longest / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def resize_area(image: UInt8[np.ndarray, "H W C"], width: int, height: int) -> UInt8[np.ndarray, "h w C"]:
    """RGB as it is, RGBA with premultiplied alpha: straight colours under alpha 0 are arbitrary, mostly black, and would give
    objects a dark rim."""
    if image.shape[:2] == (height, width):
        return image
    if image.shape[2] == 3:
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    large = image.astype(np.float32)
    large[..., :3] *= large[..., 3:] / 255
    rgba = np.asarray(cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA), np.float32)
    rgba[..., :3] /= np.maximum(rgba[..., 3:] / 255, 1e-6)
    return np.rint(rgba).clip(0, 255).astype(np.uint8)
