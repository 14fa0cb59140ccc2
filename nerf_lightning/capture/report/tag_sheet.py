"""Contact sheets of photos with their detected tags, and each photo's reprojection error or why it was excluded."""

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
MAX_PHOTOS = 24
"""Most photos of one folder on a sheet."""
LEGEND = "Outlined: detected tags and ids. Crosses: reprojected corners. px: RMS reprojection error."
TEXT_PX, CROSS_PX = 18, 5
"""Size of the captions' letters, and length of a cross's arms."""


def draw_tag_sheet(folders: Mapping[str, Sequence[RegisteredPhoto]], aspect: float) -> UInt8[np.ndarray, "H W 3"]:
    """Draws the photos of each folder below each other; of many, an evenly spaced subset.

    Args:
        folders: photos by title.
        aspect: width / height of most photos.
    """
    sheets: list[UInt8[np.ndarray, "H W 3"]] = []
    for title, photos in folders.items():
        numbers = subsample_photos(photos, MAX_PHOTOS)
        shown = [photos[number] for number in numbers]
        columns = min(6, max(3, ceil(sqrt(1.5 * len(shown)))))
        width = (SHEET_WIDTH_PX - GAP_PX) // columns - GAP_PX
        with ThreadPoolExecutor(NUM_THREADS) as pool:
            thumbnails = list(pool.map(partial(draw_detections, width=width, height=round(width / aspect)), shown))
        num_excluded = sum(bool(photo.reason) for photo in photos)
        heading = f"{title}: {len(photos)} photos, {num_excluded or 'none'} excluded"
        if len(shown) < len(photos):
            heading += f"; {len(shown)} are shown"
        flagged = [i for i, photo in enumerate(shown) if photo.reason]
        captions = [f"{number + 1}: {format_caption(photos[number])}" for number in numbers]
        heading = heading if sheets else f"{LEGEND}\n{heading}"
        sheets.append(make_contact_sheet(thumbnails, captions, columns, SHEET_WIDTH_PX, flagged, heading, TEXT_PX))
    return np.concatenate(sheets)


def subsample_photos(photos: Sequence[RegisteredPhoto], max_photos: int) -> list[int]:
    """Indices of at most `max_photos` evenly spaced photos, in order; up to half of them are excluded ones."""
    if len(photos) <= max_photos:
        return list(range(len(photos)))
    excluded = [i for i, photo in enumerate(photos) if photo.reason]
    used = [i for i, photo in enumerate(photos) if not photo.reason]
    shown = [excluded[i] for i in subsample(len(excluded), max_photos // 2)]
    return sorted(shown + [used[i] for i in subsample(len(used), max_photos - len(shown))])


def format_caption(photo: RegisteredPhoto) -> str:
    """Formats a photo's name, and its reprojection error or why it was excluded."""
    if photo.reason:
        return f"{photo.name}, excluded: {photo.reason}"
    method = f", by its {photo.method}" if photo.method else ""
    return f"{photo.name}{method}, {photo.reprojection_px:.2f} px"


def draw_detections(photo: RegisteredPhoto, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a photo, scaled to fit `width` x `height` pixels, with tags outlined and a cross at each reprojected corner."""
    pixels = np.ascontiguousarray(read_pixels(photo.observation.path, upright=True)[..., :3])
    thumbnail = fit_image(pixels, width, height)
    scale = thumbnail.shape[1] / pixels.shape[1]
    image = Image.fromarray(thumbnail)
    draw = ImageDraw.Draw(image)
    font = ImageFont.truetype(findfont(FONT), TEXT_PX)
    for tag, detection in photo.observation.detections.items():
        outline = scale * cv2.convexHull(detection.pixels.astype(np.float32)).reshape(-1, 2)
        for color, line_width in (("black", 4), (ORANGE, 2)):
            draw.polygon([tuple(corner) for corner in outline.tolist()], outline=color, width=line_width)
        draw.text(tuple(outline.mean(0)), str(tag), ORANGE, font, anchor="mm", stroke_width=2, stroke_fill="black")
    for tag, residuals in photo.residuals.items():
        for x, y in scale * (photo.observation.detections[tag].pixels + residuals):
            for color, line_width in (("black", 3), (SKY, 1)):
                draw.line((x - CROSS_PX, y, x + CROSS_PX, y), color, line_width)
                draw.line((x, y - CROSS_PX, x, y + CROSS_PX), color, line_width)
    return np.array(image)
