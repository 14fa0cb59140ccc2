"""Labels beside markers, placed to cover as little as possible."""

import math

from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.text import Annotation
from matplotlib.transforms import Bbox, BboxBase

from nerf_lightning.drawing.ink import readable

CORNERS = ((-1, 1), (1, -1), (1, 1), (-1, -1))
"""Above left first: along a frontier that rises there is room."""
SPOTS = [(7 * across, 5 * distance * up) for distance in (1, 2, 3, 5, 7) for across, up in CORNERS]
"""Where a name may stand beside its point, in points, the nearest first."""


def add_name(axes: Axes, text: str, x: float, y: float, colour: str, size: float) -> None:
    """A name beside a point; `place_names` finds its place."""
    label = axes.annotate(readable(text), (x, y), (6, 4), textcoords="offset points", parse_math=False)
    label.set(fontsize=size, color=colour, zorder=6)


def place_names(axes: Axes) -> None:
    """Moves names to where they cover no marker and no other name, as far as there is such a place."""
    point = axes.figure.dpi / 72
    taken: list[BboxBase] = []
    for collection in axes.collections:
        assert isinstance(collection, PathCollection)  # what scatter makes; a panel has nothing else
        for x, y in axes.transData.transform(collection.get_offsets()):
            radius = math.sqrt(float(collection.get_sizes()[0])) / 2 * point
            taken.append(Bbox.from_extents(x - radius, y - radius, x + radius, y + radius))
    frame = axes.get_window_extent()
    for text in axes.texts:
        if not isinstance(text, Annotation):
            continue
        extent = text.get_window_extent()
        x, y = axes.transData.transform(text.xy).tolist()

        def covers(spot: tuple[int, int]) -> float:
            """Square pixels of markers and names under the text, those outside the frame counting three times."""
            box = _beside((x, y), spot, extent.width, extent.height, point)  # noqa: B023  (called in this round only)
            outside = box.width * box.height - _overlap(box, frame)
            return 3 * outside + sum(_overlap(box, other) for other in taken)

        best = min(SPOTS, key=covers)  # of equal ones the first, which is the nearest
        text.set_position(best)
        text.set(horizontalalignment="left" if best[0] > 0 else "right")
        text.set(verticalalignment="bottom" if best[1] > 0 else "top")
        taken.append(_beside((x, y), best, extent.width, extent.height, point))


def _beside(anchor: tuple[float, float], spot: tuple[int, int], width: float, height: float, point: float) -> Bbox:
    """The box of a text whose nearest corner is a spot's offset away from its anchor, pixels."""
    x, y = anchor[0] + spot[0] * point, anchor[1] + spot[1] * point
    return Bbox.from_bounds(x if spot[0] > 0 else x - width, y if spot[1] > 0 else y - height, width, height)


def _overlap(one: BboxBase, other: BboxBase) -> float:
    shared = Bbox.intersection(one, other)
    return 0.0 if shared is None else shared.width * shared.height
