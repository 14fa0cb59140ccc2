"""Contact sheets: images of any size in a grid, each with a caption below it."""

import textwrap
from collections.abc import Container, Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from matplotlib.font_manager import findfont
from numpy import ndarray
from PIL import Image, ImageDraw, ImageFont

from nerf_lightning.drawing.style import FONT, VERMILLION, replace_missing_glyphs

GAP_PX = 12
LETTER_WIDTH_RATIO = 0.6
"""Mean letter width of `FONT` relative to its size."""


def make_contact_sheet(
    images: Sequence[UInt8[ndarray, "_ _ 3"] | None],
    captions: Sequence[str],
    columns: int,
    width: int | None = None,
    flagged: Container[int] = (),
    heading: str = "",
    text_px: int = 15,
) -> UInt8[ndarray, "H W 3"]:
    """Arranges images row by row on a white sheet.

    Args:
        images: None draws a gray box; an empty list gives the heading alone.
        captions: one per image, wrapped to its width.
        columns: most images side by side.
        width: of the sheet in pixels, to which images are scaled; None keeps the images' sizes.
        flagged: indices of images to outline in vermillion.
        heading: above all images.
        text_px: size of the captions' letters; those of the heading are larger by half.
    """
    columns = max(1, min(columns, len(images)))
    shapes = [image.shape[:2] for image in images if image is not None] or [(3, 4)]
    if width is None:
        cell = max(w for _, w in shapes)
        box, width = max(h for h, _ in shapes), columns * (cell + GAP_PX) + GAP_PX
    else:
        cell = (width - GAP_PX) // columns - GAP_PX
        box = round(cell * float(np.median([h / w for h, w in shapes])))
    missing = np.full((box, cell, 3), 221, np.uint8)
    scaled = [missing if image is None else fit_image(image, cell, box) for image in images]
    texts = [wrap_text(caption, cell, text_px) for caption in captions]
    title = wrap_text(heading, width - 2 * GAP_PX, 3 * text_px // 2)
    line = round(1.3 * text_px)
    tops = [GAP_PX + 3 * line // 2 * len(title)]
    for first in range(0, len(images), columns):
        row = range(first, min(first + columns, len(images)))
        tops.append(tops[-1] + max(scaled[i].shape[0] + line * len(texts[i]) for i in row) + 2 * GAP_PX)

    sheet = Image.new("RGB", (width, tops[-1]), "white")
    draw = ImageDraw.Draw(sheet)
    small, large = (ImageFont.truetype(findfont(FONT), size) for size in (text_px, 3 * text_px // 2))
    for n, words in enumerate(title):
        draw.text((GAP_PX, GAP_PX // 2 + n * (3 * line // 2)), words, "black", large)
    for i, (image, text) in enumerate(zip(scaled, texts, strict=True)):
        left, top = GAP_PX + i % columns * (cell + GAP_PX), tops[i // columns]
        right, bottom = left + image.shape[1], top + image.shape[0]
        sheet.paste(Image.fromarray(image), (left, top))
        if i in flagged:
            draw.rectangle((left - 4, top - 4, right + 3, bottom + 3), outline=VERMILLION, width=4)
        for n, words in enumerate(text):
            draw.text((left, bottom + 5 + n * line), words, VERMILLION if i in flagged else "black", small)
    return np.array(sheet)


def fit_image(image: UInt8[ndarray, "H W 3"], width: int, height: int) -> UInt8[ndarray, "h w 3"]:
    """Scales an image to fit a box: area-averaged if smaller, nearest neighbor if larger."""
    rows, cols = image.shape[:2]
    scale = min(width / cols, height / rows)
    size = max(1, round(cols * scale)), max(1, round(rows * scale))
    if size == (cols, rows):
        return image
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST))


def wrap_text(text: str, width: int, text_px: int) -> list[str]:
    """Wraps text to about `width` pixels; keeps its line breaks."""
    letters = max(1, int(width / (LETTER_WIDTH_RATIO * text_px)))
    return [line for part in text.splitlines() for line in textwrap.wrap(replace_missing_glyphs(part), letters)]
