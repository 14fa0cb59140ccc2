"""Synthetic photos of a printed sheet and an object, with known cameras and lens."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Float, UInt8

from benchmarks.synthetic.tabletop import Tabletop
from benchmarks.synthetic.viewpoints import make_object_cameras, make_sheet_cameras
from nerf_lightning.capture.poses.geometry import normalize_pixels
from nerf_lightning.capture.tags.tag_layout import TagLayout
from nerf_lightning.dataset.intrinsics import Intrinsics
from nerf_lightning.synthetic.tracer import render_shadow_map

BLOCK = 32
"""Side of the blocks that are traced at once, pixels: their rays fit into a core's cache."""


@dataclass(frozen=True)
class Flaws:
    """Blur and noise of a real camera."""

    blur: float = 0.5
    """Standard deviation of a Gaussian blur, pixels."""
    noise: float = 2.0
    """Standard deviation of Gaussian noise, 8-bit levels."""


@dataclass(frozen=True)
class Truth:
    """Ground truth of a capture."""

    lens: Intrinsics
    layout: TagLayout
    calibration: dict[str, Float[np.ndarray, "4 4"]]
    """Camera to world, meters, by file name, of the photos of the sheet alone."""
    photos: dict[str, Float[np.ndarray, "4 4"]]
    """The same of the photos of the object."""


def render_photo(
    layout: TagLayout,
    lens: Intrinsics,
    c2w: Float[np.ndarray, "4 4"],
    with_object: bool,
    flaws: Flaws,
    seed: int,
    samples: int = 3,
    hidden: bool = False,
) -> UInt8[np.ndarray, "H W 3"]:
    """Renders a photo of the tabletop, sRGB.

    Each pixel is the mean of a grid of rays in sRGB, so that edges lie where half of a pixel's area is dark. (A sensor
    averages linear light, which shifts edges toward dark areas; detectors that fit edges in sRGB would be blamed for it.)

    Args:
        layout: tags lying in the plane z = 0.
        lens: with or without distortion.
        c2w: the camera, above the table; meters.
        with_object: whether the bulldozer stands on the table.
        flaws: blur and noise added to the exact image.
        seed: of the noise.
        samples: rays along each side of a pixel.
        hidden: whether a blank sheet covers the tags.
    """
    tabletop = Tabletop(layout, hidden)
    exact = np.empty((lens.height, lens.width, 3), np.float32)
    grid = _compute_tangents(lens, samples)
    for top in range(0, lens.height, BLOCK):
        for left in range(0, lens.width, BLOCK):
            block = np.s_[top : top + BLOCK, left : left + BLOCK]
            rays = grid[block].reshape(-1, 2) @ c2w[:3, :2].T + c2w[:3, 2]
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            colors = tabletop.colors(c2w[:3, 3], rays, with_object)
            exact[block] = colors.reshape(*grid[block].shape[:3], 3).mean(2)
    photo: np.ndarray = 255 * exact
    if flaws.blur > 0:
        photo = cv2.GaussianBlur(photo, (0, 0), flaws.blur)
    photo += flaws.noise * np.random.default_rng(seed).standard_normal(photo.shape, np.float32)
    return np.rint(photo).clip(0, 255).astype(np.uint8)


@functools.lru_cache(maxsize=1)
def _compute_tangents(lens: Intrinsics, n: int) -> Float[np.ndarray, "H W S 2"]:
    """Normalized coordinates x / z, y / z of all samples; cached, because undistortion takes as long as a photo.

    The samples of a pixel form a grid that is sheared both ways, so that no two share a row or a column: axis-aligned edges
    are as smooth as others.
    """
    i, j = (k.reshape(-1) for k in np.meshgrid(np.arange(n), np.arange(n)))
    col, row = np.meshgrid(np.arange(lens.width), np.arange(lens.height))
    x, y = col[..., None] + (i + (j + 0.5) / n) / n, row[..., None] + (j + (n - i - 0.5) / n) / n
    pixels = np.stack([x, y], axis=-1)
    rows = [normalize_pixels(lens, row_pixels.reshape(-1, 2)).astype(np.float32) for row_pixels in pixels]
    return np.stack(rows).reshape(pixels.shape)


def write_capture(
    folder: Path,
    layout: TagLayout,
    lens: Intrinsics,
    sheet_views: int,
    object_views: int,
    flaws: Flaws,
    seed: int = 0,
    steps: int | None = None,
    samples: int = 3,
    hide: int | None = None,
) -> Truth:
    """Writes `calibration/000.png ...`, photos of the sheet alone, and `photos/000.png ...`, photos with the object.

    Args:
        folder: created if missing.
        layout: tags lying in the plane z = 0.
        lens, flaws: of all photos.
        sheet_views, object_views: numbers of photos.
        seed: of cameras and noise; deterministic to the byte.
        steps: photos of the object per full turn; None spreads them evenly.
        samples: see `render_photo`.
        hide: the tags are hidden in every N-th photo of the object, from the second on; None: in none.
    """
    _compute_tangents(lens, samples)  # cached, like the shadow map, before the threads need it
    render_shadow_map()
    seeds = iter(np.random.SeedSequence(seed).generate_state(2 + sheet_views + object_views).tolist())
    poses = {
        "calibration": make_sheet_cameras(layout, lens, sheet_views, next(seeds)),
        "photos": make_object_cameras(layout, lens, object_views, next(seeds), steps),
    }
    named = {kind: {f"{i:03d}.png": c2w for i, c2w in enumerate(c2ws)} for kind, c2ws in poses.items()}

    def write(kind: str, name: str, photo_seed: int) -> None:
        of_object = kind == "photos"
        hidden = of_object and hide is not None and int(Path(name).stem) % hide == 1
        photo = render_photo(layout, lens, named[kind][name], of_object, flaws, photo_seed, samples, hidden)
        imageio.imwrite(folder / kind / name, photo)

    jobs = [(kind, name, next(seeds)) for kind, photos in named.items() for name in photos]
    for kind in named:
        (folder / kind).mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        list(pool.map(lambda job: write(*job), jobs))
    return Truth(lens, layout, **named)
