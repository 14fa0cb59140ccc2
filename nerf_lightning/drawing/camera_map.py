"""Camera map of a scene: cameras, tags, sparse points, box and orbit."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from nerf_lightning.dataset.scene import Scene
from nerf_lightning.drawing.style import BLUE, DPI, GRAY, ORANGE, VERMILLION

FRUSTUM_FRACTION = 0.06
"""Height of a camera's frustum relative to the map's width."""
FRUSTUM_STROKE = [0, 1, 2, 0, 3, 2, 3, 4, 0, 4, 1]
"""Corners of a frustum in an order that draws all of its edges."""
CENTERED_TEXT: dict[str, Any] = {"ha": "center", "va": "center", "annotation_clip": True}
MAX_NUMBERED = 120
"""Most cameras with numbers; of more, every N-th."""
MAX_POINTS = 5000
MAX_WIDTH_INCHES, MAX_HEIGHT_INCHES = 13.0, 17.0


def frustum_corners(K: Float[np.ndarray, "3 3"], width: int, height: int, depth: float) -> Float[np.ndarray, "5 3"]:
    """Camera center and image corners at a depth, in the camera frame."""
    corners = np.array([[0, 0, 1], [width, 0, 1], [width, height, 1], [0, height, 1]], dtype=np.float64)
    return depth * np.concatenate([np.zeros((1, 3)), np.linalg.solve(K, corners.T).T])


def plot_camera_map(
    numbered: Sequence[tuple[int, Float[np.ndarray, "4 4"]]],
    scene: Scene,
    tags: dict[int, Float[np.ndarray, "M 3"]],
    unit: str = "in the scene's unit",
) -> Figure:
    """Plots the cameras of a scene from above and, below, from the side, at the same scale.

    Args:
        numbered: photos' numbers and poses, camera to world.
        scene: the scene of these photos.
        tags: world positions of corners, by tag id.
        unit: unit of length, for the axes.
    """
    camera = scene.train.cameras[0].to_pinhole()
    orbit, box = scene.orbit.centers.double().numpy(), scene.bounds.aabb.double().numpy()
    positions = np.concatenate([np.stack([c2w[:3, 3] for _, c2w in numbered]), orbit, box, *tags.values()])
    depth = FRUSTUM_FRACTION * float(np.ptp(positions[:, :2], axis=0).max())
    shape = frustum_corners(camera.K[0].double().numpy(), *camera.size(0), depth)
    frusta = np.stack([shape @ c2w[:3, :3].T + c2w[:3, 3] for _, c2w in numbered])
    all_points = np.concatenate([positions, frusta.reshape(-1, 3)])
    low, high = all_points.min(0) - depth / 2, all_points.max(0) + depth / 2

    span = high - low
    scale = min(MAX_WIDTH_INCHES / span[0], MAX_HEIGHT_INCHES / (span[1] + span[2]))
    size = max(scale * span[0] + 1.5, 8.0), scale * (span[1] + span[2]) + 2.5
    figure = Figure(figsize=size, dpi=DPI, layout="constrained")
    above, side = figure.subplots(2, 1, height_ratios=(span[1], span[2]), sharex=True)
    for axes, up, name in ((above, 1, "from above"), (side, 2, "from the side")):
        axes.set(xlim=(low[0], high[0]), ylim=(low[up], high[up]), aspect="equal", ylabel=f"{'xyz'[up]}, {unit}")
        axes.set_title(name, loc="left")
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        broken = np.pad(frusta[:, FRUSTUM_STROKE][..., [0, up]], ((0, 0), (0, 1), (0, 0)), constant_values=np.nan)
        axes.plot(*broken.reshape(-1, 2).T, color=BLUE, linewidth=0.8, label="cameras, numbered as the photos are")
        for tag, corners in tags.items():
            label = "" if tag != next(iter(tags)) else "tags, with their ids"
            axes.fill(corners[:, 0], corners[:, up], facecolor="0.8", edgecolor="black", label=label)
        x, y = box[[0, 1, 1, 0, 0], 0], box[[0, 0, 1, 1, 0], up]
        axes.plot(x, y, "--", color=GRAY, linewidth=1.5, label="box of the scene")
        closed = np.concatenate([orbit, orbit[:1]])
        axes.plot(closed[:, 0], closed[:, up], color=ORANGE, linewidth=2, label="orbit")
        if scene.points is not None:
            subset = scene.points[:: -(-len(scene.points) // MAX_POINTS)].numpy()
            axes.plot(subset[:, 0], subset[:, up], ".", color="0.6", markersize=1.5, zorder=0.5, label="known points")
        for (number, _), points in list(zip(numbered, frusta, strict=True))[:: -(-len(frusta) // MAX_NUMBERED)]:
            label_position = points[0] - 0.35 * (points[1:].mean(0) - points[0])  # behind the camera
            axes.annotate(str(number), label_position[[0, up]], fontsize=8, **CENTERED_TEXT)
    side.set_xlabel(f"x, {unit}")
    for tag, corners in tags.items():
        above.annotate(str(tag), corners[:, :2].mean(0), fontsize=9, color=VERMILLION, **CENTERED_TEXT)
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper center", ncols=4, frameon=False)
    return figure
