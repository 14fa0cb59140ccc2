"""PixelSubset: which pixels of a view are rendered, where all would take too long."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.utils.text import subsample

STRIP_ROWS = 32
"""Rows of a strip: enough for the windows of SSIM."""


@dataclass(frozen=True)
class PixelSubset:
    """Evenly spaced pixels of a view. Their mean squared error estimates that of all pixels without bias."""

    stride: int = 1
    """Between the rows and between the columns that are taken: a smaller picture of the whole view."""
    row_fraction: float = 1.0
    """With a stride of 1: the share of the rows that are taken, in strips of `STRIP_ROWS`."""

    @property
    def strip(self) -> int | None:
        """How many rows lie side by side; None for all of a view's."""
        return 1 if self.stride > 1 else STRIP_ROWS if self.row_fraction < 1 else None

    def grid(self, width: int, height: int) -> tuple[Int[Tensor, "h"], Int[Tensor, "w"]]:
        """The rows and the columns that are taken; at least one strip."""
        if self.stride > 1:
            across, down = (
                torch.arange(min(self.stride // 2, side - 1), side, self.stride) for side in (width, height)
            )
            return down, across
        strips = max(1, round(self.row_fraction * height / STRIP_ROWS))
        if self.row_fraction >= 1 or strips * STRIP_ROWS >= height:
            return torch.arange(height), torch.arange(width)
        starts = torch.tensor(subsample(height // STRIP_ROWS, strips)) * STRIP_ROWS
        return (starts[:, None] + torch.arange(STRIP_ROWS)).flatten(), torch.arange(width)


ALL_PIXELS = PixelSubset()


def make_subset(pixels: float, max_pixels: float) -> PixelSubset:
    """Every n-th row and column, so that of so many pixels about `max_pixels` remain."""
    return PixelSubset(max(1, math.ceil(math.sqrt(pixels / max(max_pixels, 1)))))
