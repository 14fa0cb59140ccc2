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

from nerf_lightning.capture.poses.pose_solver import RegisteredPhoto
from nerf_lightning.capture.tags.detect import NUM_THREADS
from nerf_lightning.dataset.formats.image_files import read_pixels
from nerf_lightning.drawing.contact_sheet import GAP_PX, fit_image, make_contact_sheet
from nerf_lightning.drawing.style import FONT, ORANGE, SKY
from nerf_lightning.utils.text import subsample

SHEET_WIDTH_PX = 2400
"""Pixels."""
MAX_PHOTOS = 24
"""Of one folder on a sheet."""
LEGEND = (
    "Outlined: detected tags and ids. Crosses: where the solved cameras put the corners. px: rms reprojection error."
)
TEXT_PX = 18
"""Size of the captions' letters."""
CROSS_PX = 5
"""Length of a cross's arms."""


def draw_tag_sheet(folders: Mapping[str, Sequence[RegisteredPhoto]], aspect: float) -> UInt8[np.ndarray, "H W 3"]:
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
        width = (SHEET_WIDTH_PX - GAP_PX) // columns - GAP_PX
        with ThreadPoolExecutor(NUM_THREADS) as pool:
            small = list(pool.map(partial(draw_detections, width=width, height=round(width / aspect)), shown))
        left_out = sum(bool(photo.reason) for photo in photos)
        heading = f"{title}: {len(photos)} photos, {left_out or 'none'} left out"
        if len(shown) < len(photos):
            heading += f"; {len(shown)} evenly chosen ones are shown"
        flagged = [i for i, photo in enumerate(shown) if photo.reason]
        captions = [f"{number + 1}: {format_caption(photos[number])}" for number in numbers]
        heading = heading if sheets else f"{LEGEND}\n{heading}"
        sheets.append(make_contact_sheet(small, captions, columns, SHEET_WIDTH_PX, flagged, heading, TEXT_PX))
    return np.concatenate(sheets)


def subsample_photos(photos: Sequence[RegisteredPhoto], most: int) -> list[int]:
    """Indices of at most this many photos, evenly chosen, in order; up to half of them are of those left out."""
    if len(photos) <= most:
        return list(range(len(photos)))
    left_out = [i for i, photo in enumerate(photos) if photo.reason]
    used = [i for i, photo in enumerate(photos) if not photo.reason]
    shown = [left_out[i] for i in subsample(len(left_out), most // 2)]
    return sorted(shown + [used[i] for i in subsample(len(used), most - len(shown))])


def format_caption(photo: RegisteredPhoto) -> str:
    """Name, and reprojection error or why it was left out."""
    if photo.reason:
        return f"{photo.name}, left out: {photo.reason}"
    how = f", by its {photo.method}" if photo.method else ""
    return f"{photo.name}{how}, {photo.reprojection_px:.2f} px"


def draw_detections(photo: RegisteredPhoto, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """A photo scaled to fit into a box of `width` x `height` pixels: its tags are outlined with their ids, and a cross shows
    where each corner projects to. All lines have a dark rim, which shows on paper as well as on ink."""
    pixels = np.ascontiguousarray(read_pixels(photo.observation.path, upright=True)[..., :3])
    small = fit_image(pixels, width, height)
    scale = small.shape[1] / pixels.shape[1]
    image = Image.fromarray(small)
    draw = ImageDraw.Draw(image)
    font = ImageFont.truetype(findfont(FONT), TEXT_PX)
    for tag, detection in photo.observation.detections.items():
        outline = scale * cv2.convexHull(detection.pixels.astype(np.float32)).reshape(-1, 2)
        for colour, thick in (("black", 4), (ORANGE, 2)):
            draw.polygon([tuple(corner) for corner in outline.tolist()], outline=colour, width=thick)
        draw.text(tuple(outline.mean(0)), str(tag), ORANGE, font, anchor="mm", stroke_width=2, stroke_fill="black")
    for tag, residuals in photo.residuals.items():
        for x, y in scale * (photo.observation.detections[tag].pixels + residuals):
            for colour, thick in (("black", 3), (SKY, 1)):
                draw.line((x - CROSS_PX, y, x + CROSS_PX, y), colour, thick)
                draw.line((x, y - CROSS_PX, x, y + CROSS_PX), colour, thick)
    return np.array(image)
