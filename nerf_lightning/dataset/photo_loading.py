"""Loads posed photos (decoding, masks, resizing) into Views."""

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from nerf_lightning.cameras import Cameras, Lenses
from nerf_lightning.dataset.formats.image_files import MAX_DECODE_THREADS, read_exposure, read_image_size, read_pixels
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.dataset.masks import MASK_THRESHOLD, is_cut_out_by_mask, is_inverted, read_mask
from nerf_lightning.dataset.orientation import has_same_aspect
from nerf_lightning.dataset.resize import AutoResize, choose_resize, find_downscaled, fit_size, resize_area
from nerf_lightning.dataset.views import Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.progress import track_progress
from nerf_lightning.utils.text import subsample

log = logging.getLogger(__name__)

MaskMeaning = Literal["auto", "ignore", "background"]
Orientation = Literal["auto", "stored", "exif"]
MAX_INSPECTED_MASKS, INSPECTED_SIDE_PX = 8, 1000
"""Evenly spaced photos whose masks are inspected, and their longest side then."""
MIN_VALID_COVERAGE = 250
"""Mask coverage, in 1/255, from which an area-averaged pixel is valid."""


@dataclass(frozen=True)
class PhotoLoadOptions:
    """Options for reading posed photos.

    Args:
        resize: longest side in pixels, to which larger photos are area-averaged; "auto" or an `AutoResize` chooses it, None
            keeps the size.
        holdout: hold out every N-th photo, sorted by name, if the format defines no split.
        masked: meaning of masked or transparent pixels: "ignore" (unknown: not sampled, not scored) or "background" (the
            subject is cut out); "auto" takes alpha, and masks whose masked region has one color, as background.
        invert_masks: masks are black where the photo is kept.
        bounded: "true", "false", or "auto" to classify the photos, see `classify_scene`.
        orientation: "stored", "exif" or "auto", see `choose_orientations`.
    """

    resize: int | str | AutoResize | None = None
    holdout: int = 8
    masked: MaskMeaning = "auto"
    invert_masks: bool = False
    bounded: Literal["auto", "true", "false"] = "auto"
    orientation: Orientation = "auto"


DEFAULT_OPTIONS = PhotoLoadOptions()


@dataclass(frozen=True)
class PosedPhoto:
    """One photo with its pose, intrinsics and mask."""

    name: str
    """As in the scene file."""
    file: Path
    c2w: Float[np.ndarray, "4 4"]
    """Camera to world, OpenCV, the file's world frame and unit."""
    intrinsics: Intrinsics
    """At the photo's size or a multiple of it."""
    mask: Path | None = None
    upright: bool = False
    """Whether pose and intrinsics refer to the EXIF-rotated photo."""


def load_views(source: Path, photos: Sequence[PosedPhoto], options: PhotoLoadOptions) -> Views:
    """Decodes photos and area-averages them to the requested size. Poses stay in the file's frame.

    Raises:
        InputError: a photo is unreadable or does not match its camera's size, or the photos do not fit into memory.
    """
    headers = [read_image_size(photo.file, photo.upright) for photo in photos]
    for photo, (width, height, _) in zip(photos, headers, strict=True):
        check_photo_shape(source, photo, width, height)
    has_alpha = any(alpha for _, _, alpha in headers)
    masked = interpret_masks(photos, options)
    is_cutout = masked == "background"
    channels = 4 if is_cutout or (has_alpha and options.masked != "ignore") else 3
    sizes = [(width, height) for width, height, _ in headers]
    longest = choose_resize(source, sizes, channels, options.resize)
    sizes = [fit_size(*size, longest) for size in sizes]
    offsets = np.cumsum([0] + [width * height for width, height in sizes])
    check_memory(source, "", f"{len(photos)} photos", float(offsets[-1]) * channels, "give a smaller dataset.resize")
    pixels = np.empty((offsets[-1], channels), np.uint8)
    valid = np.ones(offsets[-1] if masked or has_alpha else 0, bool)

    def read(i: int) -> None:
        file = photos[i].file if longest is None else find_downscaled(photos[i].file, sizes[i], photos[i].upright)
        image = read_pixels(file, photos[i].upright, sizes[i])
        mask_file, (height, width) = photos[i].mask, image.shape[:2]
        mask = None if mask_file is None else read_mask(mask_file, width, height, options.invert_masks)
        image, mask = merge_mask(image, mask, channels, is_cutout)
        part = slice(offsets[i], offsets[i + 1])
        pixels[part] = resize_area(image, *sizes[i]).reshape(-1, channels)
        if mask is not None:
            valid[part] = cv2.resize(mask, sizes[i], interpolation=cv2.INTER_AREA).ravel() >= MIN_VALID_COVERAGE

    with ThreadPoolExecutor(MAX_DECODE_THREADS) as pool:
        for _ in track_progress(pool.map(read, range(len(photos))), len(photos), "reading photos"):
            pass
    exposures = [exposure for photo in photos if (exposure := read_exposure(photo.file)) is not None]
    return Views(
        torch.from_numpy(pixels),
        make_cameras(photos).resize(torch.tensor(sizes)),
        None if valid.all() else torch.from_numpy(valid),
        tuple(photo.name for photo in photos),
        tuple(exposures) if len(exposures) == len(photos) else (),
    )


def check_photo_shape(source: Path, photo: PosedPhoto, width: int, height: int) -> None:
    """Raises InputError if a photo does not have its camera's aspect ratio."""
    stated = photo.intrinsics.width, photo.intrinsics.height
    if not has_same_aspect((width, height), stated):
        expected = f"{stated[0]}x{stated[1]}, the size of its camera, or a reduced copy"
        raise InputError(photo.file, "", f"{width}x{height} pixels", expected, f"are these the photos of {source}?")


def merge_mask(
    image: UInt8[np.ndarray, "H W _"], mask: UInt8[np.ndarray, "H W"] | None, channels: int, is_cutout: bool
) -> tuple[UInt8[np.ndarray, "H W C"], UInt8[np.ndarray, "H W"] | None]:
    """Converts a photo to `channels` and merges its mask: cutouts into alpha, alpha without a channel into the mask."""
    rgb, alpha = image[..., :3], image[..., 3] if image.shape[2] == 4 else None
    if channels == 3:
        masks = [x for x in (mask, alpha) if x is not None]
        return np.ascontiguousarray(rgb), np.minimum.reduce(masks) if masks else None
    alpha = np.full(image.shape[:2], 255, np.uint8) if alpha is None else alpha
    if is_cutout:
        alpha, mask = (alpha if mask is None else np.minimum(alpha, mask)), None
    return np.dstack([rgb, alpha]), mask


def make_cameras(photos: Sequence[PosedPhoto]) -> Cameras:
    """Builds the cameras of photos at the size of their intrinsics; poses in float64."""
    intrinsics = [photo.intrinsics for photo in photos]
    lenses = None
    if any(i.is_distorted for i in intrinsics):
        coefficients = torch.tensor([i.distortion for i in intrinsics])
        lenses = Lenses(coefficients.float(), torch.tensor([i.projection for i in intrinsics]))
    K, c2w = (torch.from_numpy(np.stack(x)) for x in ([i.K for i in intrinsics], [photo.c2w for photo in photos]))
    return Cameras(K.float(), c2w, torch.tensor([(i.width, i.height) for i in intrinsics]), lenses)


def interpret_masks(photos: Sequence[PosedPhoto], options: PhotoLoadOptions) -> str | None:
    """Decides from a few mask files what masked pixels mean, see `PhotoLoadOptions.masked`; None without masks."""
    masks = [(photo, photo.mask) for photo in photos if photo.mask is not None]
    if not masks:
        return None
    kept: list[Bool[np.ndarray, "_ _"]] = []
    cutouts = []
    for photo, mask in (masks[i] for i in subsample(len(masks), MAX_INSPECTED_MASKS)):
        size = read_image_size(photo.file, photo.upright)[:2]
        image = read_pixels(photo.file, photo.upright, fit_size(*size, INSPECTED_SIDE_PX))
        kept.append(read_mask(mask, image.shape[1], image.shape[0], options.invert_masks) >= MASK_THRESHOLD)
        cutouts.append(is_cut_out_by_mask(image, kept[-1]))
    if is_inverted(kept):
        text = "most masks remove a region in the middle: are they inverted? Set dataset.invert_masks=%s if so"
        log.warning(text, str(not options.invert_masks).lower())
    meaning = options.masked
    if meaning == "auto":
        meaning = "background" if np.mean(cutouts) > 0.5 else "ignore"
    masked_fraction = 1 - float(np.mean([mask.mean() for mask in kept]))
    log.info("masks remove about %.0f %% of the pixels, treated as %s", 100 * masked_fraction, meaning)
    return meaning
