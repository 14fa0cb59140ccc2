"""A map of a scene: the cameras, the tags, known points, and its box and orbit."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.ink import BLUE, DPI, GREY, ORANGE, VERMILLION

FRUSTUM = 0.06
"""Height of a camera's pyramid as a share of the map's width."""
EDGES = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
NUMBERS = 120
"""Most cameras that are numbered; of more, every N-th is."""
MAX_POINTS = 5000
WIDE, HIGH = 13.0, 17.0
"""Largest size of the map, inches."""


def frustum(K: Float[np.ndarray, "3 3"], width: int, height: int, depth: float) -> Float[np.ndarray, "5 3"]:
    """A camera's centre and the picture's corners at a depth, in the camera's frame."""
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], dtype=np.float64)
    return depth * np.concatenate([np.zeros((1, 3)), np.linalg.solve(K, corners.T).T])


def camera_map(
    numbered: Sequence[tuple[int, Float[np.ndarray, "4 4"]]],
    scene: Scene,
    tags: dict[int, Float[np.ndarray, "M 3"]],
    unit: str = "in the scene's unit",
) -> Figure:
    """A view from above, and one from the side below it, at the same scale.

    Args:
        numbered: photos' numbers and poses, camera to world.
        scene: made of them.
        tags: corners in the world by id.
        unit: of lengths, in words.
    """
    camera = scene.train.cameras[0].as_pinholes()
    orbit = scene.orbit.centres.double().numpy()
    box = scene.bounds.aabb.double().numpy()
    solid = np.concatenate([np.stack([c2w[:3, 3] for _, c2w in numbered]), orbit, box, *tags.values()])
    depth = FRUSTUM * float(np.ptp(solid[:, :2], axis=0).max())
    shape = frustum(camera.K[0].double().numpy(), *camera.size(0), depth)
    frusta = [(number, shape @ c2w[:3, :3].T + c2w[:3, 3]) for number, c2w in numbered]
    everything = np.concatenate([solid, *[points for _, points in frusta]])
    low, high = everything.min(0) - depth / 2, everything.max(0) + depth / 2

    span = high - low
    scale = min(WIDE / span[0], HIGH / (span[1] + span[2]))
    size = max(scale * span[0] + 1.5, 8.0), scale * (span[1] + span[2]) + 2.5
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    above, beside = figure.subplots(2, 1, height_ratios=(span[1], span[2]), sharex=True)
    for axes, up, name in ((above, 1, "from above"), (beside, 2, "from the side")):
        axes.set(xlim=(low[0], high[0]), ylim=(low[up], high[up]), aspect="equal", ylabel=f"{'xyz'[up]}, {unit}")
        axes.set_title(name, loc="left")
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        if scene.points is not None:
            some = scene.points[:: -(-len(scene.points) // MAX_POINTS)].numpy()
            axes.plot(some[:, 0], some[:, up], ".", color="0.6", markersize=1.5, zorder=0.5)
        _draw(axes, [0, up], frusta, tags, orbit, box)
    beside.set_xlabel(f"x, {unit}")
    for tag, corners in tags.items():
        x, y = corners[:, :2].mean(0)
        above.annotate(str(tag), (x, y), ha="center", va="center", fontsize=9, color=VERMILLION, annotation_clip=True)
    key = [
        Line2D([], [], color=BLUE, label="cameras, numbered as the photos are"),
        Line2D([], [], color=GREY, linestyle="--", label="box of the scene"),
        Line2D([], [], color=ORANGE, linewidth=2, label="orbit"),
    ]
    if scene.points is not None:
        key.append(Line2D([], [], color="0.6", marker=".", linestyle="", label="known points"))
    if tags:
        label = "tags, with their ids"
        key[1:1] = [Line2D([], [], color="black", marker="s", markerfacecolor="0.8", linestyle="", label=label)]
    figure.legend(handles=key, loc="outside upper center", ncols=4, frameon=False)
    return figure


def _draw(
    axes: Axes,
    plane: list[int],
    frusta: Sequence[tuple[int, Float[np.ndarray, "5 3"]]],
    tags: dict[int, Float[np.ndarray, "M 3"]],
    orbit: Float[np.ndarray, "F 3"],
    box: Float[np.ndarray, "2 3"],
) -> None:
    axes.add_collection(
        PolyCollection([c[:, plane] for c in tags.values()], facecolors="0.8", edgecolors="black", linewidths=1.0)
    )
    closed = np.concatenate([orbit, orbit[:1]])[:, plane]
    axes.plot(*closed.T, color=ORANGE, linewidth=2)
    (left, bottom), (right, top) = box[:, plane]
    axes.plot([left, right, right, left, left], [bottom, bottom, top, top, bottom], "--", color=GREY, linewidth=1.5)
    lines = [points[edge][:, plane] for _, points in frusta for edge in map(list, EDGES)]
    axes.add_collection(LineCollection(lines, colors=BLUE, linewidths=0.8, alpha=0.8))
    step = -(-len(frusta) // NUMBERS)
    for number, points in frusta[::step]:
        # Behind the camera, where there are no lines.
        behind = points[0] - 0.35 * points[1:].mean(0) + 0.35 * points[0]
        axes.annotate(str(number), behind[plane], ha="center", va="center", fontsize=8, annotation_clip=True)
