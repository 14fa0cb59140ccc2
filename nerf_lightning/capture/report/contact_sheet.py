"""Contact sheets: small photos with their tags outlined, and the error of each photo or why it was left out."""

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from math import ceil, sqrt

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from nerf_lightning.capture.photo_status import PhotoStatus, subsample_photos
from nerf_lightning.capture.tags.detect import THREADS
from nerf_lightning.dataset.formats.decode import read_pixels
from nerf_lightning.drawing.contact_sheet import GAP, contact_sheet
from nerf_lightning.drawing.ink import ORANGE, SKY, rgb

WIDTH = 2400
"""Of a sheet, pixels."""
MOST = 24
"""Photos of one folder on a sheet."""
KEY = "Outlined: tags as found, with their ids. Crosses: where the solved cameras put the corners. px: rms reprojection error."
TEXT_PX = 18
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


def tag_sheet(folders: Mapping[str, Sequence[PhotoStatus]], aspect: float) -> UInt8[np.ndarray, "H W 3"]:
    """The photos of each folder, one folder below the other; an even choice where there are many.

    Args:
        folders: their statuses, by title.
        aspect: width / height of most photos.
    """
    sheets: list[UInt8[np.ndarray, "H W 3"]] = []
    for title, statuses in folders.items():
        shown = subsample_photos(statuses, MOST)
        columns = min(6, max(3, ceil(sqrt(1.5 * len(shown)))))
        width = (WIDTH - GAP) // columns - GAP
        with ThreadPoolExecutor(THREADS) as pool:
            small = list(pool.map(partial(_thumbnail, width=width, height=round(width / aspect)), shown))
        text = heading(title, statuses, shown) if sheets else f"{KEY}\n{heading(title, statuses, shown)}"
        left_out = [i for i, status in enumerate(shown) if status.reason]
        captions = [status.caption for status in shown]
        sheets.append(contact_sheet(small, captions, columns, WIDTH, left_out, text, TEXT_PX))
    return np.concatenate(sheets)


def _thumbnail(status: PhotoStatus, width: int, height: int) -> UInt8[np.ndarray, "h w 3"]:
    photo = np.ascontiguousarray(read_pixels(status.path, upright=True)[..., :3])
    return annotated(photo, status, width, height)
