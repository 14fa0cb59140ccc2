"""A picture as features on nested hash grids and one small network (Instant-NGP, Müller et al. 2022, section 5.1)."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import mlp
from nerf_lightning.model.field import PictureField
from nerf_lightning.model.hashgrid import HashGrid, level_resolutions, table_sizes
from nerf_lightning.model.layers.networks import layers, linears, weights, widen
from nerf_lightning.utils.options import AtLeast, AtMost, Count, Layers, Positive, Side

STEP = 2.4
"""How much finer each level is than the one before, unless their number is given."""


class HashGrid2DField(PictureField):
    """Hash-grid features of a position, and a network that turns them into a colour.

    The finest level has a vertex at the centre of every pixel: the picture could not fill a finer one.

    Args:
        size: see `PictureField`.
        levels: number of grids; fewer for a picture so small that some would be equal. None: each is about 2.4 times finer than
            the one before.
        log2_entries: each level has at most 2^log2_entries entries; levels too fine for that share them by hashing. None picks
            the largest for which all levels together hold at most `share` times as many numbers as the picture.
        share: of the picture's numbers, unless `log2_entries` is given. Shared entries cost most of all in what is fine
            everywhere, as grain, fur and letters; from about 0.8 on none are.
        features: numbers per entry.
        coarsest: cells along the longer side of the first level, at most as many as pixels.
        finest: the same for the last level; None makes it as fine as the pixels.
        width: neurons of the hidden layer.
        rate: factor on the learning rate.
    """

    def __init__(
        self,
        size: tuple[int, int],
        levels: Layers | None = None,
        log2_entries: Annotated[int, AtLeast(1), AtMost(24)] | None = None,
        share: Positive = 1.0,
        features: Count = 2,
        coarsest: Side = 16,
        finest: Side | None = None,
        width: Count = 64,
        rate: Positive = 2.0,
    ):
        super().__init__(size, rate)
        cells = [max(side - 1, 1) for side in size]
        pixels, finest = max(cells), min(max(cells), finest or max(cells))
        first = finest if levels == 1 else min(coarsest, finest)
        levels = levels or 1 + round(math.log(finest / first) / math.log(STEP))
        scaled = [[max(1, round(c * r / pixels)) for c in cells] for r in level_resolutions(levels, first, finest)]
        resolutions = list(dict.fromkeys((across, down) for across, down in scaled))  # a small picture has fewer
        if log2_entries is None:
            numbers = share * 3 * size[0] * size[1]
            fitting = [e for e in range(4, 25) if sum(table_sizes(resolutions, 2**e)) * features <= numbers]
            log2_entries = max(fitting, default=4)
        self.grid = HashGrid(resolutions, log2_entries, features)
        self.net = layers(self.grid.width, width, 3)

    def warm_start_from(self, smaller: PictureField) -> None:
        """Copies a field that has no other levels."""
        assert isinstance(smaller, HashGrid2DField)
        if (columns := self.grid.warm_start_from(smaller.grid)) is not None:
            widen(linears(self.net), linears(smaller.net), columns)

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        width, height = self.size
        pixels = uv * uv.new_tensor([width, height]) - 0.5
        unit = pixels / uv.new_tensor([max(width - 1, 1), max(height - 1, 1)])
        return torch.sigmoid(mlp(self.grid(unit), weights(self.net)))
