"""The worst renders of a suite on one page."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import imageio.v3 as imageio
from matplotlib.figure import Figure

from nerf_lightning.drawing.ink import DPI, VERMILLION, readable
from nerf_lightning.stability.cell import Outcome
from nerf_lightning.stability.verdict import Square

MOST, COLUMNS = 30, 6


def worst_page(found: Sequence[Square], folder_of: Callable[[Outcome], Path]) -> Figure:
    """The last render of the worst seed of each condition and method, the worst first.

    Args:
        found: all that was tried.
        folder_of: where a cell left its render.
    """
    lowest = [(min(square.outcomes, key=_quality), square) for square in found]
    pictures = [(_picture(folder_of(one)), one, square) for one, square in lowest]
    shown = sorted([entry for entry in pictures if entry[0].exists()], key=lambda entry: _quality(entry[1]))[:MOST]
    rows = max(1, math.ceil(len(shown) / COLUMNS))
    figure = Figure(figsize=(2 * COLUMNS, 2.6 * rows), dpi=DPI, layout="constrained")
    for axes in figure.subplots(rows, COLUMNS, squeeze=False).flat:
        axes.axis("off")
    for axes, (picture, one, square) in zip(figure.axes, shown, strict=False):
        axes.imshow(imageio.imread(picture), interpolation="nearest")
        told = "no figure" if one.psnr is None else f"{one.psnr:.1f} dB"
        axes.set_title(
            f"{readable(one.condition)}\n{readable(one.method)}\nseed {one.seed}: {told}",
            fontsize=7.5,
            color=VERMILLION if one in square.failed else "black",
            parse_math=False,
        )
    return figure


def _picture(folder: Path) -> Path:
    """What a cell was judged by: of a picture, all that lies between its pixels too."""
    enlarged = folder / "enlarged.png"
    return enlarged if enlarged.exists() else folder / "final.png"


def _quality(one: Outcome) -> float:
    return -math.inf if one.psnr is None else one.psnr
