"""Warm starts of larger fields, and pruning."""

from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds
from nerf_lightning.model import (
    Field,
    HashGrid2DField,
    HashGridField,
    MLPField,
    PictureField,
    PictureMLP,
    TensoRFField,
    VoxelField,
)
from nerf_lightning.model.layers.grid_masks import vertices_of_cells

BOX = Bounds(torch.tensor([[-1.0, -0.5, 0.2], [1.5, 2.0, 1.0]]))


def hashgrid(entries: int = 6, width: int = 8, **options: int) -> Field:
    field = HashGridField(
        BOX, num_levels=3, log2_hashmap_size=entries, base_resolution=3, max_resolution=12, width=width, **options
    )
    torch.nn.init.normal_(field.grid.tables)
    return field


def tensorf(components: int = 3, colors: int = 3, max_resolution: int = 6, width: int = 8, degree: int = 3) -> Field:
    """With numbers of components for which kernels are already compiled."""
    return TensoRFField(BOX, components, colors, max_resolution, max_resolution, stages=1, width=width, degree=degree)


def voxels(max_resolution: int = 6, degree: int = 1, base_resolution: int = 6) -> Field:
    field = VoxelField(BOX, base_resolution, max_resolution, degree=degree)
    for table in field.tables:
        torch.nn.init.normal_(table)
    return field


def mlp(width: int = 8, depth: int = 2, skip: int | None = None) -> Field:
    return MLPField(BOX, depth, width, skip, position_frequencies=3, direction_frequencies=2, density="exp")


SAME = [
    (hashgrid, {}, {"entries": 13, "width": 12}),
    (tensorf, {"degree": 1}, {"degree": 3, "max_resolution": 12, "width": 16, "components": 8, "colors": 8}),
    (voxels, {}, {"degree": 2, "max_resolution": 12}),
    (mlp, {}, {"depth": 4, "width": 16}),
]


@pytest.mark.parametrize(("make", "small", "large"), SAME)
def test_warm_start_larger_field_is_same_function_and_learns(make: Callable[..., Field], small: dict, large: dict):
    smaller, larger = make(**small), make(**large)
    positions = BOX.to_world(torch.rand(60, 3))
    directions = normalize(torch.randn(60, 3), dim=1)
    target = smaller(positions, directions)
    assert (larger(positions, directions)[1] - target[1]).abs().max() > 1e-3, "the functions differ before"
    larger.warm_start_from(smaller)
    for actual, expected in zip(larger(positions, directions)[:2], target[:2], strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
    optimizer = torch.optim.Adam(larger.parameters(), lr=1e-2)
    before = [parameter.detach().clone() for parameter in larger.parameters()]
    for _ in range(3):
        optimizer.zero_grad()
        density, rgb, _ = larger(positions, directions)
        (density.square().mean() + rgb.square().mean()).backward()
        optimizer.step()
    for (name, parameter), old in zip(larger.named_parameters(), before, strict=True):
        moved = (parameter.detach() - old).abs().flatten(1 if parameter.ndim > 1 and "net" in name else 0).amax(-1)
        assert (moved > 0).float().mean() > (0.5 if "net" in name or "trunk" in name else 0), f"{name} learns"


def hashgrid2d(num_levels: int = 2, max_resolution: int = 8, width: int = 8) -> PictureField:
    field = HashGrid2DField(
        (32, 24), num_levels, log2_hashmap_size=10, base_resolution=4, max_resolution=max_resolution, width=width
    )
    torch.nn.init.normal_(field.grid.tables)
    return field


def picture_mlp(num_frequencies: int = 2, width: int = 8) -> PictureField:
    return PictureMLP((32, 24), num_frequencies, width, depth=2)


@pytest.mark.parametrize(
    ("make", "large"),
    [
        (hashgrid2d, {"num_levels": 3, "max_resolution": 16, "width": 16}),
        (picture_mlp, {"width": 20, "num_frequencies": 3}),
    ],
)
def test_warm_start_larger_picture_field_is_same_function(make: Callable[..., PictureField], large: dict):
    smaller, larger = make(), make(**large)
    uv = torch.rand(50, 2)
    larger.warm_start_from(smaller)
    torch.testing.assert_close(larger(uv), smaller(uv), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("cells", [1, 3, 8, 13])
def test_vertices_of_cells_are_their_corners(cells: int):
    visible_cells = torch.zeros(8, 8, 8, dtype=torch.bool)
    visible_cells[2, 5, 7] = visible_cells[0, 0, 3] = True
    expected = torch.zeros(cells + 1, cells + 1, cells + 1, dtype=torch.bool)
    for cell in visible_cells.nonzero():
        samples = (cell + torch.rand(3000, 3)) / 8
        low = (samples * cells).long().clamp(max=cells - 1)
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
            expected[tuple((low + corner).T)] = True
    assert torch.equal(vertices_of_cells(visible_cells, cells), expected)


@pytest.mark.parametrize("make", [hashgrid, tensorf, voxels, mlp])
def test_prune_visible_cells_keep_their_values(make: Callable[[], Field]):
    field, visible_cells = make(), torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)) < 0.02
    cells = visible_cells.nonzero().repeat(20, 1)
    positions = BOX.to_world((cells + torch.rand(len(cells), 3)) / 8)
    directions = normalize(torch.randn(len(positions), 3), dim=1)
    before = [part.detach() for part in field(positions, directions)[:2]]
    field.prune(visible_cells)
    for actual, expected in zip(field(positions, directions)[:2], before, strict=True):
        torch.testing.assert_close(actual, expected)
