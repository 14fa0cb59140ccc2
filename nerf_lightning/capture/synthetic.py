"""Synthetic captures: photos of a printed sheet and an object through a known lens, with the flaws of real ones."""

import functools
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
from jaxtyping import Bool, Float, UInt8

from nerf_lightning.capture.poses.geometry import normalised
from nerf_lightning.capture.tabletop import Tabletop
from nerf_lightning.capture.tags.layout import TagLayout
from nerf_lightning.capture.viewpoints import object_cameras, sheet_cameras
from nerf_lightning.dataset.bricks.trace import shadow
from nerf_lightning.dataset.lens import Lens
from nerf_lightning.utils.files import atomic

SUPERSAMPLING = 3
"""Samples a pixel along each side."""
BLOCK = 32
"""Side of the blocks in pixels that are traced at once: as many rays as stay in a core's cache."""
SKIN = np.array([0.80, 0.58, 0.49])
"""sRGB of the finger before the lens."""


@dataclass(frozen=True)
class Flaws:
    """What cameras and photographers add."""

    blur: float = 0.5
    """Standard deviation of a Gaussian, pixels."""
    noise: float = 2.0
    """Standard deviation of Gaussian noise in steps of the 8-bit values."""
    exposure: float = 0.0
    """Each photo's 8-bit values are multiplied by a gain between 1 / (1 + exposure) and 1 + exposure."""
    occluded: float = 0.0
    """Share of the photos with a finger in the frame."""


@dataclass(frozen=True)
class Truth:
    """What a capture must find out."""

    lens: Lens
    layout: TagLayout
    calibration: dict[str, Float[np.ndarray, "4 4"]]
    """Camera to world in metres, by the name of the file, for the photos of the sheet alone."""
    photos: dict[str, Float[np.ndarray, "4 4"]]
    """Likewise for the photos of the object."""


def render_photo(
    layout: TagLayout, lens: Lens, c2w: Float[np.ndarray, "4 4"], with_object: bool, flaws: Flaws, seed: int
) -> UInt8[np.ndarray, "H W 3"]:
    """A photo of the tabletop.

    Each pixel is the mean of a grid of exact rays, taken in sRGB: an edge runs where half of a pixel's area is dark, and its
    values lie half-way between dark and bright there. (A sensor's mean is taken in linear light, which makes bright areas a
    little larger; detectors that fit edges in sRGB would then be blamed for it.)

    Args:
        layout: tags lying in the plane z = 0.
        lens: with or without distortion.
        c2w: the camera, above the table; metres.
        with_object: whether the bulldozer stands on the table.
        flaws: what is added to the exact picture.
        seed: of all that is random in the flaws.

    Returns:
        sRGB.
    """
    tabletop, n = Tabletop(layout), SUPERSAMPLING
    exact = np.empty((lens.height, lens.width, 3), np.float32)
    grid = _tangents(lens)
    for top in range(0, lens.height, BLOCK):
        for left in range(0, lens.width, BLOCK):
            tangents = grid[top : top + BLOCK, left : left + BLOCK]
            rays = tangents.reshape(-1, 2) @ c2w[:3, :2].T + c2w[:3, 2]
            rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
            colours = tabletop.colours(c2w[:3, 3], rays, with_object)
            exact[top : top + BLOCK, left : left + BLOCK] = colours.reshape(*tangents.shape[:2], n * n, 3).mean(2)
    return _flawed(exact, flaws, np.random.default_rng(seed))


@functools.lru_cache(maxsize=1)
def _tangents(lens: Lens) -> Float[np.ndarray, "H W S 2"]:
    """x / z and y / z of all samples in the camera frame; kept, because undoing the distortion takes as long as a photo.

    The samples of a pixel form a grid that is sheared both ways, so that no two share a row or a column: edges along the
    frame come out as smooth as others.
    """
    n = SUPERSAMPLING
    i, j = (k.reshape(-1) for k in np.meshgrid(np.arange(n), np.arange(n)))
    x, y = (i + (j + 0.5) / n) / n, (j + (n - i - 0.5) / n) / n
    cols, rows = np.arange(lens.width)[None, :, None] + x, np.arange(lens.height)[:, None, None] + y
    out = np.empty((lens.height, lens.width, n * n, 2), np.float32)
    for row in range(lens.height):
        pixels = np.stack(np.broadcast_arrays(cols[0], rows[row]), axis=-1)
        out[row] = normalised(lens, pixels.reshape(-1, 2)).reshape(pixels.shape)
    out.setflags(write=False)
    return out


def _flawed(exact: Float[np.ndarray, "H W 3"], flaws: Flaws, rng: np.random.Generator) -> UInt8[np.ndarray, "H W 3"]:
    """The photo that comes of an exact picture in sRGB, [0, 1]."""
    # Drawn whether needed or not, so that one flaw's strength does not change the others.
    finger, place, stops = rng.random(), rng.random(4), rng.uniform(-1, 1)
    out = 255 * exact
    if finger < flaws.occluded:
        out[_finger(out.shape[1], out.shape[0], place)] = 255 * SKIN
    if flaws.blur > 0:
        out = cv2.GaussianBlur(out, (0, 0), flaws.blur)
    out *= (1 + flaws.exposure) ** stops
    out += flaws.noise * rng.standard_normal(out.shape, np.float32)
    return np.rint(out).clip(0, 255).astype(np.uint8)


def _finger(width: int, height: int, chance: Float[np.ndarray, "4"]) -> Bool[np.ndarray, "H W"]:
    """Pixels within an ellipse that reaches in from somewhere on the frame's edge."""
    turn = 2 * np.pi * chance[0]
    edge = np.array([np.cos(turn), np.sin(turn)])
    edge /= np.abs(edge).max()
    x, y = (edge + 1) / 2 * (width, height)
    long, short = np.array([0.20 + 0.15 * chance[1], 0.08 + 0.06 * chance[2]]) * max(width, height)
    slant = np.arctan2(height / 2 - y, width / 2 - x) + 0.8 * (chance[3] - 0.5)
    rows, cols = np.mgrid[:height, :width] + 0.5
    along = (cols - x) * np.cos(slant) + (rows - y) * np.sin(slant)
    across = (rows - y) * np.cos(slant) - (cols - x) * np.sin(slant)
    return (along / long) ** 2 + (across / short) ** 2 < 1


def write_capture(
    folder: Path,
    layout: TagLayout,
    lens: Lens,
    sheet_views: int = 20,
    object_views: int = 30,
    flaws: Flaws = Flaws(),
    seed: int = 0,
) -> Truth:
    """Writes `calibration/000.png ...`, photos of the sheet alone, and `photos/000.png ...`, photos with the object.

    Args:
        folder: made if it does not exist.
        layout: tags lying in the plane z = 0.
        lens: of all photos.
        sheet_views: how many photos of the sheet.
        object_views: how many photos of the object.
        flaws: of all photos.
        seed: of cameras and flaws; the same one gives the same bytes.

    Returns:
        What the photos were made from.
    """
    _tangents(lens)  # made once, before the threads ask for it, and so is the shadow
    shadow()
    seeds = iter(np.random.SeedSequence(seed).generate_state(2 + sheet_views + object_views).tolist())
    c2ws = {
        "calibration": sheet_cameras(layout, lens, sheet_views, next(seeds)),
        "photos": object_cameras(layout, lens, object_views, next(seeds)),
    }
    jobs = [(kind, i, next(seeds)) for kind, poses in c2ws.items() for i in range(len(poses))]

    def write(kind: str, i: int, photo_seed: int) -> None:
        photo = render_photo(layout, lens, c2ws[kind][i], kind == "photos", flaws, photo_seed)
        with atomic(folder / kind / _name(i)) as temporary:
            imageio.imwrite(temporary, photo)

    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        list(pool.map(lambda job: write(*job), jobs))
    named = {kind: {_name(i): pose for i, pose in enumerate(poses)} for kind, poses in c2ws.items()}
    return Truth(lens, layout, named["calibration"], named["photos"])


def _name(index: int) -> str:
    return f"{index:03d}.png"
