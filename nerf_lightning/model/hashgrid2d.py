"""Multiresolution hash grid and small network for a picture (Instant-NGP, Müller et al. 2022, section 5.1)."""

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
"""Growth factor between levels, unless their number is given."""


class HashGrid2DField(PictureField):
    """Hash-grid features of a position and a color network. The finest level has a vertex at every pixel center.

    Args:
        size: see `PictureField`.
        num_levels: number of grids; equal ones are merged. None: a growth factor of about 2.4.
        log2_hashmap_size: log2 of a level's maximum number of entries; finer levels are hashed. None: the largest within
            `parameter_ratio`.
        parameter_ratio: maximum number of grid parameters relative to the picture's numbers. From about 0.8 on nothing is
            hashed; collisions cost most where the whole picture has fine detail (grain, fur, text).
        features_per_level: features per entry.
        base_resolution: cells along the longer side of the first level, at most one per pixel.
        max_resolution: the same for the last level; None: one per pixel.
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
        levels = level_resolutions(num_levels, first, max_resolution)
        across, down = ([max(1, round(c * r / pixels)) for r in levels] for c in cells)
        resolutions = list(dict.fromkeys(zip(across, down, strict=True)))  # small pictures repeat a level
        if log2_hashmap_size is None:
            limit = parameter_ratio * 3 * size[0] * size[1]
            log2_sizes = [e for e in range(4, 25) if sum(table_sizes(resolutions, 2**e)) * features_per_level <= limit]
            log2_hashmap_size = max(log2_sizes, default=4)
        self.grid = HashGrid(resolutions, log2_hashmap_size, features_per_level)
        self.net = build_layers(self.grid.width, width, 3)

    def warm_start_from(self, smaller: PictureField) -> None:
        """Copies a field whose levels are all among this one's."""
        assert isinstance(smaller, HashGrid2DField)
        if (columns := self.grid.warm_start_from(smaller.grid)) is not None:
            widen(linear_layers(self.net), linear_layers(smaller.net), columns)

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        width, height = self.size
        pixels = uv * uv.new_tensor([width, height]) - 0.5
        unit = pixels / uv.new_tensor([max(width - 1, 1), max(height - 1, 1)])
        return torch.sigmoid(mlp(self.grid(unit), layer_parameters(self.net)))
