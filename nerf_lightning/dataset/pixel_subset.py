"""PixelSubset: pixels of a view to render where all would take too long."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor

from nerf_lightning.utils.text import subsample

STRIP_ROWS = 32
"""Rows of a strip, enough for SSIM windows."""


@dataclass(frozen=True)
class PixelSubset:
    """Evenly spaced pixels of a view. Their MSE is an unbiased estimate of that of all pixels."""

    stride: int = 1
    """Spacing of rows and columns: a downsampled view."""
    row_fraction: float = 1.0
    """For stride 1: fraction of the rows, in strips of `STRIP_ROWS`."""

    @property
    def strip(self) -> int | None:
        """Adjacent rows in a strip; None for whole views."""
        return 1 if self.stride > 1 else STRIP_ROWS if self.row_fraction < 1 else None

    def grid(self, width: int, height: int) -> tuple[Int[Tensor, "h"], Int[Tensor, "w"]]:
        """Row and column indices of the subset; at least one strip."""
        if self.stride > 1:
            columns, rows = (torch.arange(min(self.stride // 2, n - 1), n, self.stride) for n in (width, height))
            return rows, columns
        strips = max(1, round(self.row_fraction * height / STRIP_ROWS))
        if self.row_fraction >= 1 or strips * STRIP_ROWS >= height:
            return torch.arange(height), torch.arange(width)
        starts = torch.tensor(subsample(height // STRIP_ROWS, strips)) * STRIP_ROWS
        return (starts[:, None] + torch.arange(STRIP_ROWS)).flatten(), torch.arange(width)


ALL_PIXELS = PixelSubset()


def make_subset(pixels: float, max_pixels: float) -> PixelSubset:
    """Strides so that about `max_pixels` of `pixels` remain."""
    return PixelSubset(max(1, math.ceil(math.sqrt(pixels / max(max_pixels, 1)))))
