"""Views of which every second pixel is rendered, and the others only where their neighbors differ."""

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Rays

MAX_NEIGHBOR_SPREAD = 16 / 255
"""Difference in color and opacity among four neighbors up to which the pixel between them is interpolated."""


def render_checkerboard(march: Callable[[Rays], Float[Tensor, "r 5"]], rays: Rays, width: int) -> Float[Tensor, "R 5"]:
    """Renders a view as a checkerboard; the fields between are interpolated where their four neighbors agree.

    An interpolated pixel has the mean color and opacity of its neighbors, and the distance of one of them: a mean of two
    surfaces would lie between them.

    Args:
        march: renders rays; its columns are color, opacity and distance.
        rays: of a view with at least two rows, row-major.
        width: of the view, at least 2.
    """
    index = torch.arange(len(rays), device=rays.origins.device)
    is_between = (index // width + index % width) % 2 == 1
    values = rays.origins.new_zeros(len(rays), 5)
    values[~is_between] = march(rays[~is_between])
    padded = torch.nn.functional.pad(values.T.reshape(5, -1, width), (1, 1, 1, 1), mode="reflect")
    up, down = padded[:, :-2, 1:-1], padded[:, 2:, 1:-1]
    left, right = padded[:, 1:-1, :-2], padded[:, 1:-1, 2:]
    low, high = torch.minimum(torch.minimum(up, down), torch.minimum(left, right)), torch.maximum(up, down)
    mean = (up + down + left + right) / 4
    mean[4] = torch.minimum(high[4], torch.maximum(left[4], right[4]))
    spread = torch.maximum(high, torch.maximum(left, right)) - low
    is_smooth = is_between & (spread[:4] < MAX_NEIGHBOR_SPREAD).all(0).flatten()
    values[is_smooth] = mean.flatten(1).T[is_smooth]
    is_left = is_between & ~is_smooth
    values[is_left] = march(rays[is_left])
    return values
