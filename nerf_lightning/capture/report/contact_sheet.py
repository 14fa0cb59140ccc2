"""Contact sheets: small photos with their tags outlined, and the error of each photo or why it was left out."""

import textwrap
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from math import ceil, sqrt

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure

from nerf_lightning.capture.photo_status import PhotoStatus, subsample_photos
from nerf_lightning.capture.tags.detect import THREADS
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.drawing.ink import DPI, FONT, ORANGE, SKY, VERMILLION, readable, rgb

WIDTH = 2400
"""Of a sheet, pixels."""
MOST = 24
"""Photos of one folder on a sheet."""
KEY = "Outlined: tags as found, with their ids. Crosses: where the solved cameras put the corners. px: rms reprojection error."
GAP, LINE, HEADING = 12, 26, 64
"""Pixels between photos, a line of a caption, and of a folder's heading."""
POINTS = 13
"""Size of the captions' letters."""
SHIFT = 4
"""OpenCV draws at 1 / 2^SHIFT pixels."""


def annotated(
    photo: UInt8[np.ndarray, "H W 3"], status: PhotoStatus, width: int, height: int
) -> UInt8[np.ndarray, "h w 3"]:
    """A photo (sRGB, upright, at full size) scaled to fit into a box of `width` x `height` pixels: its tags are outlined with
    their ids, and a cross shows where each corner projects to."""
    rows, cols = photo.shape[:2]
    scale = min(width / cols, height / rows)
    size = max(1, round(cols * scale)), max(1, round(rows * scale))
    small = cv2.resize(photo, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    stretch = np.array([size[0] / cols, size[1] / rows])

    def drawn(pixels: Float[np.ndarray, "M 2"]) -> Float[np.ndarray, "M 2"]:
        return pixels * stretch - 0.5  # OpenCV puts pixel centres at integers

    for tag, mark in status.marks.items():
        outline = cv2.convexHull(drawn(mark.pixels).astype(np.float32)).reshape(-1, 2)
        _lines(small, [outline], True, rgb(ORANGE), 2)
        _label(small, str(tag), outline.mean(0), float(np.sqrt(cv2.contourArea(outline))))
    for tag, residuals in status.residuals.items():
        for place in drawn(status.marks[tag].pixels + residuals):
            _lines(small, [place + [[-5, 0], [5, 0]], place + [[0, -5], [0, 5]]], False, rgb(SKY), 1)
    return small


def _lines(
    image: UInt8[np.ndarray, "H W 3"],
    lines: list[Float[np.ndarray, "M 2"]],
    closed: bool,
    colour: tuple[int, int, int],
    thickness: int,
) -> None:
    """Lines with a dark rim, which show on paper as well as on ink."""
    fixed = [np.rint(line * 2**SHIFT).astype(np.int32).reshape(-1, 1, 2) for line in lines]
    for ink, wide in (((0, 0, 0), thickness + 2), (colour, thickness)):
        cv2.polylines(image, fixed, closed, ink, wide, cv2.LINE_AA, SHIFT)


def _label(image: UInt8[np.ndarray, "H W 3"], text: str, middle: Float[np.ndarray, "2"], side: float) -> None:
    """A tag's id in its middle, larger on large tags."""
    scale = float(np.clip(side / 70, 0.5, 1.0))
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 2)
    place = round(float(middle[0]) - width / 2), round(float(middle[1]) + height / 2)
    for ink, wide in (((0, 0, 0), 5), (rgb(ORANGE), 2)):
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, wide, cv2.LINE_AA)


def heading(title: str, statuses: Sequence[PhotoStatus], shown: Sequence[PhotoStatus]) -> str:
    """The line above a folder's photos."""
    left_out = sum(bool(o.reason) for o in statuses)
    text = f"{title}: {len(statuses)} photos, {left_out or 'none'} left out"
    return text if len(shown) == len(statuses) else f"{text}; {len(shown)} evenly chosen ones are shown"


def contact_sheet(folders: Mapping[str, Sequence[PhotoStatus]], aspect: float) -> Figure:
    """The photos of each folder, one folder below the other; an even choice where there are many.

    Args:
        folders: their statuses, by title.
        aspect: width / height of most photos.
    """
    strips = [_blank(2 * LINE)]
    texts: list[tuple[float, float, str, str, float]] = [(GAP, 2 * LINE - 10, KEY, "black", POINTS)]
    top = 2 * LINE
    for title, statuses in folders.items():
        shown = subsample_photos(statuses, MOST)
        texts.append((GAP, top + HEADING - 14, heading(title, statuses, shown), "black", POINTS + 7))
        strips.append(_blank(HEADING))
        top += HEADING
        columns = min(6, max(3, ceil(sqrt(1.5 * len(shown)))))
        width = (WIDTH - GAP) // columns - GAP
        height = round(width / aspect)
        with ThreadPoolExecutor(THREADS) as pool:
            small = list(pool.map(partial(_thumbnail, width=width, height=height), shown))
        for first in range(0, len(shown), columns):
            row = shown[first : first + columns]
            captions = [textwrap.wrap(readable(o.caption), int(width / (0.85 * POINTS))) for o in row]
            strip = _blank(height + LINE * max(map(len, captions)) + 2 * GAP)
            for i, (status, lines) in enumerate(zip(row, captions, strict=True)):
                left, image = GAP + i * (width + GAP), small[first + i]
                strip[: image.shape[0], left : left + image.shape[1]] = image
                colour = VERMILLION if status.reason else "black"
                for n, line in enumerate(lines):
                    below = top + image.shape[0] + (n + 1) * LINE - 4
                    texts.append((left, below, line, colour, POINTS))
            strips.append(strip)
            top += len(strip)
    return _figure(np.concatenate(strips), texts)


def _blank(height: int) -> UInt8[np.ndarray, "H W 3"]:
    return np.full((height, WIDTH, 3), 255, np.uint8)


def _thumbnail(status: PhotoStatus, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    photo = np.ascontiguousarray(read_pixels(status.path, upright=True)[..., :3])
    return annotated(photo, status, width, height)


def _figure(sheet: UInt8[np.ndarray, "H W 3"], texts: list[tuple[float, float, str, str, float]]) -> Figure:
    """A picture, pixel by pixel, with texts on it: x and y of the start of the base line, the text, its colour and size."""
    height, width = sheet.shape[:2]
    figure = Figure(figsize=(width / DPI, height / DPI), dpi=DPI)
    figure.figimage(sheet, origin="upper")
    for x, y, text, colour, points in texts:
        place = x / width, 1 - y / height
        figure.text(*place, text, color=colour, fontsize=points, fontfamily=FONT, parse_math=False)
    return figure
