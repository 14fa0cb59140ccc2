"""Style of all figures: colors, font and scales."""

import functools
import itertools
from collections.abc import Iterable

import numpy as np
from jaxtyping import UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font

BLUE, ORANGE, GREEN, SKY, VERMILLION, MAUVE, GRAY = (
    "#0072B2", "#E69F00", "#009E73", "#56B4E9", "#D55E00", "#CC79A7", "#6E6E6E",
)  # fmt: skip
"""Color-blind safe palette (Okabe and Ito 2008); excluded items are vermillion."""
PALETTE = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"), (MAUVE, "D"), (SKY, "v"), ("#000000", "P"), ("#B8A000", "X"))
"""Colors and markers of a chart's categories, in order."""
FONT = "DejaVu Sans"
"""Ships with matplotlib."""
DPI = 100


def parse_hex_color(color: str) -> tuple[int, int, int]:
    """Parses "#RRGGBB" to bytes."""
    red, green, blue = bytes.fromhex(color[1:])
    return red, green, blue


@functools.lru_cache(maxsize=1)
def _font_glyphs() -> frozenset[int]:
    return frozenset(get_font(findfont(FONT)).get_charmap())


def assign_styles(names: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Assigns a color and a marker of `PALETTE` to each category, cyclically."""
    return dict(zip(dict.fromkeys(names), itertools.cycle(PALETTE), strict=False))


def replace_missing_glyphs(text: str) -> str:
    """Replaces letters that the font lacks by question marks."""
    return "".join(letter if ord(letter) in _font_glyphs() else "?" for letter in text)


def shorten(text: str, max_letters: int) -> str:
    """Shortens text to `max_letters` by an ellipsis in the middle."""
    if len(text) <= max_letters:
        return text
    head = (max_letters - 1) // 2
    return f"{text[:head]}…{text[-(max_letters - 1 - head) :]}"


def choose_magnification(length: float, target: float) -> float:
    """Largest of 1, 2, 5, 10, 20 ... that scales `length` to at most `target`; at least 1."""
    if not 0 < length < target:
        return 1.0
    ratio = target / length
    power = 10.0 ** np.floor(np.log10(ratio))
    return float(power * max(step for step in (1, 2, 5) if step * power <= ratio * (1 + 1e-9)))


def set_image_axes(axes: Axes, width: int, height: int) -> None:
    """Sets axes to the pixel area of a photo, rows downward."""
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel="column, pixels", ylabel="row, pixels")


def rasterize_figure(figure: Figure) -> UInt8[np.ndarray, "H W 3"]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])
