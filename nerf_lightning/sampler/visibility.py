"""Which cells of a grid over the bounds enough cameras see."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras

RESOLUTION = 64
"""Cells along each side of the grid, unless told otherwise."""
MOST_CAMERAS = 128
"""Most cameras, evenly chosen, that decide which cells are in view."""


def in_view(camera: Cameras, points: Float[Tensor, "N 3"], near: float) -> Bool[Tensor, "N"]:
    """Which world points one camera sees, farther from it than `near`."""
    return camera.project(points, 0)[2] & ((points - camera.centres).norm(dim=1) > near)


def seen_cells(bounds: Bounds, cameras: Cameras, seen_by: int, resolution: int) -> Bool[Tensor, "cells"]:
    """Which cells of the unit cube have a middle that at least `seen_by` cameras see; all where none has."""
    chosen = torch.linspace(0, len(cameras) - 1, min(len(cameras), MOST_CAMERAS)).round().long()
    n = resolution
    cells = torch.arange(n**3)
    unit = (torch.stack([cells // (n * n), cells // n % n, cells % n], dim=1) + 0.5) / n
    bounds = bounds.to("cpu")
    centres, near = bounds.to_world(unit), bounds.near or 0.0
    count = torch.zeros(len(cells), dtype=torch.int32)
    wanted = min(seen_by, len(chosen))
    for camera in chosen:
        open_ones = (count < wanted).nonzero()[:, 0]  # the others have enough views already
        count[open_ones] += in_view(cameras[camera : camera + 1].to("cpu"), centres[open_ones], near).int()
    seen = count >= wanted
    return seen if seen.any() else torch.ones_like(seen)
