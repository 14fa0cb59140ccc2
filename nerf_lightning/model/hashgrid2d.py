"""A picture as features on nested hash grids and one small network (Instant-NGP, Müller et al. 2022, section 5.1)."""

import math
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels import mlp
from nerf_lightning.model.field import PictureField
from nerf_lightning.model.hashgrid import HashGrid, level_resolutions, table_sizes
from nerf_lightning.model.layers.networks import build_layers, layer_parameters, linear_layers, widen
from nerf_lightning.utils.option_checks import Count, Ge, GridSize, Layers, Le, PositiveFloat

PER_LEVEL_SCALE = 2.4
"""How much finer each level is than the one before, unless their number is given."""


class HashGrid2DField(PictureField):
    """Hash-grid features of a position, and a network that turns them into a colour.

    The finest level has a vertex at the centre of every pixel: the picture could not fill a finer one.

    Args:
        size: see `PictureField`.
        num_levels: number of grids; fewer for a picture where some would be equal. None: each is about 2.4 times finer than
            the one before.
        log2_hashmap_size: each level has at most 2^log2_hashmap_size entries; finer levels share them by hashing. None picks
            the largest for which all levels together hold at most `parameter_ratio` times as many numbers as the picture.
        parameter_ratio: of the picture's numbers, unless `log2_hashmap_size` is given. Sharing costs most in what is fine
            everywhere, as grain, fur and letters; from about 0.8 on none are.
        features_per_level: numbers per entry.
        base_resolution: cells along the longer side of the first level, at most as many as pixels.
        max_resolution: the same for the last level; None makes it as fine as the pixels.
        width: neurons of the hidden layer.
        lr_scale: factor on the learning rate.
    """

    def __init__(
        self,
        size: tuple[int, int],
        num_levels: Layers | None = None,
        log2_hashmap_size: Annotated[int, Ge(1), Le(24)] | None = None,
        parameter_ratio: PositiveFloat = 1.0,
        features_per_level: Count = 2,
        base_resolution: GridSize = 16,
        max_resolution: GridSize | None = None,
        width: Count = 64,
        lr_scale: PositiveFloat = 2.0,
    ):
        super().__init__(size, lr_scale)
        cells = [max(side - 1, 1) for side in size]
        pixels, max_resolution = max(cells), min(max(cells), max_resolution or max(cells))
        first = max_resolution if num_levels == 1 else min(base_resolution, max_resolution)
        num_levels = num_levels or 1 + round(math.log(max_resolution / first) / math.log(PER_LEVEL_SCALE))
        scaled = [
            [max(1, round(c * r / pixels)) for c in cells] for r in level_resolutions(num_levels, first, max_resolution)
        ]
        resolutions = list(dict.fromkeys((across, down) for across, down in scaled))  # a small picture has fewer
        if log2_hashmap_size is None:
            numbers = parameter_ratio * 3 * size[0] * size[1]
            fitting = [e for e in range(4, 25) if sum(table_sizes(resolutions, 2**e)) * features_per_level <= numbers]
            log2_hashmap_size = max(fitting, default=4)
        self.grid = HashGrid(resolutions, log2_hashmap_size, features_per_level)
        self.net = build_layers(self.grid.width, width, 3)

    def warm_start_from(self, smaller: PictureField) -> None:
        """Copies a field that has no other levels."""
        assert isinstance(smaller, HashGrid2DField)
        if (columns := self.grid.warm_start_from(smaller.grid)) is not None:
            widen(linear_layers(self.net), linear_layers(smaller.net), columns)

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        width, height = self.size
        pixels = uv * uv.new_tensor([width, height]) - 0.5
        unit = pixels / uv.new_tensor([max(width - 1, 1), max(height - 1, 1)])
        return torch.sigmoid(mlp(self.grid(unit), layer_parameters(self.net)))
