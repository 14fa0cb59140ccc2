"""Colours, letters and scales that all figures share."""

import functools
import itertools
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font

BLUE, ORANGE, GREEN, SKY, VERMILLION, MAUVE, GREY = (
    "#0072B2", "#E69F00", "#009E73", "#56B4E9", "#D55E00", "#CC79A7", "#6E6E6E",
)  # fmt: skip
"""Safe for colour-blind readers (Okabe and Ito 2008); what was left out is vermillion."""
PALETTE = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (MAUVE, "D"), (SKY, "v"), ("#000000", "P"), ("#B8A000", "X"))
"""Colour and marker of the first, second ... category of any chart."""
FONT = "DejaVu Sans"
"""Comes with matplotlib."""
DPI = 100


def parse_hex_colour(colour: str) -> tuple[int, int, int]:
    """ "#RRGGBB" to bytes."""
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


@functools.lru_cache(maxsize=1)
def _font_glyphs() -> frozenset[int]:
    return frozenset(get_font(findfont(FONT)).get_charmap())


def assign_styles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker by category; more than `PALETTE` holds begin again."""
    return dict(zip(dict.fromkeys(names), itertools.cycle(PALETTE), strict=False))


def replace_missing_glyphs(text: str) -> str:
    """Text with a question mark for every letter that the font lacks."""
    return "".join(letter if ord(letter) in _font_glyphs() else "?" for letter in text)


def shorten(text: str, max_letters: int) -> str:
    """Text with its middle left out where it is too long."""
    if len(text) <= max_letters:
        return text
    head = (max_letters - 1) // 2
    return f"{text[:head]}…{text[-(max_letters - 1 - head) :]}"


def choose_magnification(length: float, target: float) -> float:
    """The largest of 1, 2, 5, 10, 20 ... that makes a length no longer than the target; 1 where it is longer already."""
    if not 0 < length < target:
        return 1.0
    ratio = target / length
    power = 10.0 ** np.floor(np.log10(ratio))
    return float(power * max(step for step in (1, 2, 5) if step * power <= ratio * (1 + 1e-9)))


def set_image_axes(axes: Axes, width: int, height: int) -> None:
    """Lets a chart show the area of a photo: pixels, rows running down."""
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="column, pixels", ylabel="row, pixels")


def rasterize_figure(figure: Figure) -> UInt8[np.ndarray, "H W 3"]:
    """Draws a figure, in memory."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
