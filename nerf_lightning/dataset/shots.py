"""Posed photos on disk become a Scene, whatever format named them."""

import logging
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from nerf_lightning.cameras import Cameras, Lenses
from nerf_lightning.dataset.formats.decode import THREADS, image_header, read_pixels
from nerf_lightning.dataset.formats.header import stated_exposure
from nerf_lightning.dataset.lens import Lens, rectify
from nerf_lightning.dataset.masks import KEPT, SURE, cut_out, read_mask, seem_inverted
from nerf_lightning.dataset.optics import Optics
from nerf_lightning.dataset.orientation import has_shape
from nerf_lightning.dataset.resize import area_resize, fit_size
from nerf_lightning.dataset.size import AutoResize, choose_resize, find_reduced
from nerf_lightning.dataset.views import Runs, Views
from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import free_memory
from nerf_lightning.utils.progress import tracked
from nerf_lightning.utils.text import subsample

log = logging.getLogger(__name__)

MASKED = ("auto", "unknown", "empty")
BOUNDED = ("auto", "true", "false")
ORIENTATIONS = ("auto", "stored", "exif")
ROOM = 0.8
"""Share of the free memory that photos may take."""
MAX_REDUCTION = 16
"""Of a photo against its camera's size."""
LOOKED, LOOKED_SIDE_PX = 8, 1000
"""Photos, evenly chosen, that tell what their masks mean, and the size at which that shows."""


@dataclass(frozen=True)
class Reading:
    """How posed photos are read.

    Args:
        resize: longest side in pixels after averaging, for photos that are larger, or what chooses it; None keeps their size.
        holdout: every N-th photo is held out, in the order of their names, where the format has no split of its own.
        masked: what masks and alpha leave out is "unknown" (a passer-by: not drawn, not scored) or "empty" (the subject is
            cut out); "auto" takes alpha as empty, and masks as empty where what they leave out is of one colour.
        invert_masks: masks are black where the photo is kept.
        undistort: resample photos to those of a pinhole camera, cropped; otherwise rays follow the lens.
        bounded: "true", "false", or "auto", which decides by what the photos show, see `dataset.kind`.
        orientation: "stored", "exif", or "auto", see `dataset.orientation`.
    """

    resize: int | AutoResize | None = None
    holdout: int = 8
    masked: str = "auto"
    invert_masks: bool = False
    undistort: bool = False
    bounded: str = "auto"
    orientation: str = "auto"

    def __post_init__(self) -> None:
        if self.holdout < 2:
            raise InputError("holdout", "", str(self.holdout), "2 or more: every N-th photo is held out")
        for key, words in (("masked", MASKED), ("bounded", BOUNDED), ("orientation", ORIENTATIONS)):
            if getattr(self, key) not in words:
                raise InputError(f"dataset.{key}", "", repr(getattr(self, key)), f"one of {', '.join(words)}")


AS_IT_IS = Reading()


@dataclass(frozen=True)
class Shot:
    """One posed photo."""

    name: str
    """As its format names it."""
    photo: Path
    c2w: Float[np.ndarray, "4 4"]
    """Camera to world, OpenCV, the file's world frame and unit."""
    optics: Optics
    """Of the photo's size, or of the same photo at another one."""
    mask: Path | None = None
    upright: bool = False
    """Whether the pose and optics are those of the photo as its EXIF data turn it."""


def read_shots(source: Path, shots: Sequence[Shot], reading: Reading) -> Views:
    """Decodes photos, undistorted and resized where that is asked for. Poses stay in the file's frame.

    Raises:
        InputError: a photo that cannot be read or has another shape than its camera, or more photos than fit into memory.
    """
    sizes, alpha = [], False
    for shot in shots:
        width, height, has_alpha = image_header(shot.photo, shot.upright)
        stated = shot.optics.width, shot.optics.height
        if min(width, height) < 2 or MAX_REDUCTION * width < stated[0] or not has_shape((width, height), stated):
            expected = f"{stated[0]}x{stated[1]}, the size of its camera, or the same reduced"
            found, todo = f"{width}x{height} pixels", f"are these the photos of {source}?"
            raise InputError(shot.photo, "", found, expected, todo)
        sizes.append((width, height))
        alpha |= has_alpha
    masked = what_masks_mean(shots, reading)
    channels = 4 if masked == "empty" or (alpha and reading.masked != "unknown") else 3
    files = [shot.photo for shot in shots]
    longest = choose_resize(source, sizes, channels, reading.resize)
    small = [fit_size(*size, longest) for size in sizes]
    if longest is not None:
        files = [find_reduced(shot.photo, size, shot.upright) for shot, size in zip(shots, small, strict=True)]
        sizes = [image_header(file, shot.upright)[:2] for file, shot in zip(files, shots, strict=True)]
    undistort = lru_cache(maxsize=4)(rectify)  # one lens, or one a photo: keep the maps of a few
    lenses = [
        _pinhole(source, shot, size) if reading.undistort else None for shot, size in zip(shots, sizes, strict=True)
    ]
    starts = np.cumsum([0] + [width * height for width, height in small])
    _check_memory(source, shots, int(starts[-1]) * channels, small)
    pixels = np.empty((starts[-1], channels), np.uint8)
    known = np.ones(starts[-1], bool) if masked == "unknown" or (alpha and channels == 3) else None
    K = np.stack([shot.optics.K for shot in shots])

    def read(i: int) -> None:
        shot, size, lens = shots[i], small[i], lenses[i]
        image = read_pixels(files[i], shot.upright, size if lens is None else None)
        height, width = image.shape[:2]
        factor = sizes[i][0] // width  # of decoding
        if (factor * width, factor * height) != sizes[i]:
            expected = f"{sizes[i][0]}x{sizes[i][1]}, as its header says"
            raise InputError(files[i], "", f"{width}x{height} pixels", expected, "save it again")
        mask = None if shot.mask is None else read_mask(shot.mask, width, height, reading.invert_masks)
        if image.shape[2] == 4 and channels == 3:
            mask = image[..., 3] if mask is None else np.minimum(mask, image[..., 3])
            image = np.ascontiguousarray(image[..., :3])
        if channels == 4 and (image.shape[2] == 3 or mask is not None):
            cover = image[..., 3] if image.shape[2] == 4 else np.full(image.shape[:2], 255, np.uint8)
            cover = np.minimum(cover, mask) if mask is not None and masked == "empty" else cover
            image = np.dstack([image[..., :3], cover])
        rectified = None if lens is None else undistort(lens)
        K[i] = K[i] if rectified is None else rectified.K

        def finished(picture: UInt8[np.ndarray, "H W C"]) -> UInt8[np.ndarray, "N C"]:
            straight = picture if rectified is None else rectified.apply(picture)
            return area_resize(straight, *size).reshape(-1, picture.shape[2])

        part = slice(starts[i], starts[i + 1])
        pixels[part] = finished(image)
        if mask is not None and known is not None:
            known[part] = finished(np.dstack([mask] * 3))[:, 0] >= SURE

    with ThreadPoolExecutor(THREADS) as pool:
        for _ in tracked(pool.map(read, range(len(shots))), len(shots), "reading photos"):
            pass
    bent = None
    if any(shot.optics.bent for shot in shots) and not reading.undistort:
        coefficients = torch.tensor([shot.optics.distortion for shot in shots])
        bent = Lenses(coefficients.float(), torch.tensor([shot.optics.projection for shot in shots]))
    c2w = torch.from_numpy(np.stack([shot.c2w for shot in shots]))
    of = sizes if reading.undistort else [(shot.optics.width, shot.optics.height) for shot in shots]
    cameras = Cameras(torch.from_numpy(K).float(), c2w.float(), torch.tensor(of), bent).resized(torch.tensor(small))
    counted = None if known is None or known.all() else Runs.of(torch.from_numpy(known))
    gathered = [stated_exposure(shot.photo) for shot in shots]
    exposures = tuple(one for one in gathered if one is not None)
    names = tuple(shot.name for shot in shots)
    return Views(torch.from_numpy(pixels), cameras, counted, names, exposures if len(exposures) == len(shots) else ())


def what_masks_mean(shots: Sequence[Shot], reading: Reading) -> str | None:
    """What masks in files of their own leave out, see `Reading`; None where there are none. A few are looked at."""
    having = [shot for shot in shots if shot.mask is not None]
    if not having:
        return None
    kept: list[Bool[np.ndarray, "_ _"]] = []
    cut = []
    for shot in (having[i] for i in subsample(len(having), LOOKED)):
        assert shot.mask is not None
        size, other = image_header(shot.photo, shot.upright)[:2], image_header(shot.mask)[:2]
        image = read_pixels(shot.photo, shot.upright, fit_size(*size, LOOKED_SIDE_PX))
        kept.append(read_mask(shot.mask, image.shape[1], image.shape[0], reading.invert_masks) >= KEPT)
        cut.append(cut_out(image, kept[-1]))
        if other != size and len(kept) == 1:
            log.info("masks of %dx%d pixels are enlarged or reduced to their photos' %dx%d", *other, *size)
    if seem_inverted(kept):
        todo = "false" if reading.invert_masks else "true"
        text = "most masks leave out one spot in the middle: are they inverted? dataset.invert_masks=%s takes them so"
        log.warning(text, todo)
    meaning = reading.masked
    if meaning == "auto":
        meaning = "empty" if np.mean(cut) > 0.5 else "unknown"
    share = 1 - float(np.mean([one.mean() for one in kept]))
    log.info("masks leave out about %.0f %% of the pixels: taken as %s", 100 * share, meaning)
    return meaning


def _pinhole(source: Path, shot: Shot, size: tuple[int, int]) -> Lens:
    """The lens of a photo of this size, to be undone."""
    o, (width, height) = shot.optics, size
    x, y = width / o.width, height / o.height
    lens = replace(o, width=width, height=height, fx=o.fx * x, fy=o.fy * y, cx=o.cx * x, cy=o.cy * y).perspective()
    if lens is None:
        found = "a lens with more than these, a fisheye or a photo of all directions"
        expected = "at most k1, k2, k3, p1, p2 for undistort=true"
        raise InputError(source, shot.name, found, expected, "leave undistort=false")
    return lens


def _check_memory(source: Path, shots: Sequence[Shot], size: int, sides: Sequence[tuple[int, int]]) -> None:
    """Photos must fit into the free memory."""
    free = ROOM * free_memory()
    if size > free:
        longest = max(max(side) for side in sides)
        fits = max(1, int(longest * math.sqrt(max(free, 0) / size)))
        found = f"{len(shots)} photos that take {size / 2**30:.1f} GiB"
        raise InputError(source, "", found, f"at most {free / 2**30:.1f} GiB", f"dataset.resize={fits} would fit")
