"""Contact sheets: small photos with their tags outlined, and the error of each photo or why it was left out."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from math import ceil, sqrt

import cv2
import numpy as np
from jaxtyping import UInt8
from matplotlib.font_manager import findfont
from PIL import Image, ImageDraw, ImageFont

from nerf_lightning.capture.poses.solve import PlacedPhoto
from nerf_lightning.capture.tags.detect import THREADS
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.drawing.contact_sheet import GAP, contact_sheet, fit_into
from nerf_lightning.drawing.ink import FONT, ORANGE, SKY
from nerf_lightning.utils.text import subsample

SHEET_WIDTH = 2400
"""Pixels."""
MAX_PHOTOS = 24
"""Of one folder on a sheet."""
KEY = "Outlined: tags as found, with their ids. Crosses: where the solved cameras put the corners. px: rms reprojection error."
TEXT_PX = 18
"""Size of the captions' letters."""
CROSS_PX = 5
"""Length of a cross's arms."""


def tag_sheet(folders: Mapping[str, Sequence[PlacedPhoto]], aspect: float) -> UInt8[np.ndarray, "H W 3"]:
    """The photos of each folder, one folder below the other; an even choice where there are many.

    Args:
        folders: by title.
        aspect: width / height of most photos.
    """
    sheets: list[UInt8[np.ndarray, "H W 3"]] = []
    for title, photos in folders.items():
        numbers = subsample_photos(photos, MAX_PHOTOS)
        shown = [photos[number] for number in numbers]
        columns = min(6, max(3, ceil(sqrt(1.5 * len(shown)))))
        width = (SHEET_WIDTH - GAP) // columns - GAP
        with ThreadPoolExecutor(THREADS) as pool:
            small = list(pool.map(partial(annotate, width=width, height=round(width / aspect)), shown))
        left_out = sum(bool(photo.reason) for photo in photos)
        heading = f"{title}: {len(photos)} photos, {left_out or 'none'} left out"
        if len(shown) < len(photos):
            heading += f"; {len(shown)} evenly chosen ones are shown"
        flagged = [i for i, photo in enumerate(shown) if photo.reason]
        captions = [f"{number + 1}: {caption(photos[number])}" for number in numbers]
        heading = heading if sheets else f"{KEY}\n{heading}"
        sheets.append(contact_sheet(small, captions, columns, SHEET_WIDTH, flagged, heading, TEXT_PX))
    return np.concatenate(sheets)


def subsample_photos(photos: Sequence[PlacedPhoto], most: int) -> list[int]:
    """Indices of at most this many photos, evenly chosen, in order; up to half of them are of those left out."""
    if len(photos) <= most:
        return list(range(len(photos)))
    left_out = [i for i, photo in enumerate(photos) if photo.reason]
    used = [i for i, photo in enumerate(photos) if not photo.reason]
    shown = [left_out[i] for i in subsample(len(left_out), most // 2)]
    return sorted(shown + [used[i] for i in subsample(len(used), most - len(shown))])


def caption(photo: PlacedPhoto) -> str:
    """Name, and reprojection error or why it was left out."""
    if photo.reason:
        return f"{photo.name}, left out: {photo.reason}"
    how = f", by its {photo.by}" if photo.by else ""
    return f"{photo.name}{how}, {photo.reprojection_px:.2f} px"


def annotate(photo: PlacedPhoto, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """A photo scaled to fit into a box of `width` x `height` pixels: its tags are outlined with their ids, and a cross shows
    where each corner projects to. All lines have a dark rim, which shows on paper as well as on ink."""
    pixels = np.ascontiguousarray(read_pixels(photo.sighting.path, upright=True)[..., :3])
    small = fit_into(pixels, width, height)
    scale = small.shape[1] / pixels.shape[1]
    image = Image.fromarray(small)
    draw = ImageDraw.Draw(image)
    font = ImageFont.truetype(findfont(FONT), TEXT_PX)
    for tag, mark in photo.sighting.marks.items():
        outline = scale * cv2.convexHull(mark.pixels.astype(np.float32)).reshape(-1, 2)
        for colour, thick in (("black", 4), (ORANGE, 2)):
            draw.polygon([tuple(corner) for corner in outline.tolist()], outline=colour, width=thick)
        draw.text(tuple(outline.mean(0)), str(tag), ORANGE, font, anchor="mm", stroke_width=2, stroke_fill="black")
    for tag, residuals in photo.residuals.items():
        for x, y in scale * (photo.sighting.marks[tag].pixels + residuals):
            for colour, thick in (("black", 3), (SKY, 1)):
                draw.line((x - CROSS_PX, y, x + CROSS_PX, y), colour, thick)
                draw.line((x, y - CROSS_PX, x, y + CROSS_PX), colour, thick)
    return np.array(image)
