"""Fields left with what some cells need, and told in as little as they need."""

from collections.abc import Callable

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.model import Field, HashGridField, VoxelField
from nerf_lightning.model.layers.pruning import vertices_in
from tests.model.test_warm_start import BOX, hashgrid, mlp, tensorf, voxels

FIELDS = pytest.mark.parametrize("make", [hashgrid, tensorf, voxels, mlp])
Make = Callable[[], Field]


@pytest.mark.parametrize("cells", [1, 3, 8, 13])
def test_vertices_in_reached_cells_are_their_corners(cells: int):
    reached = torch.zeros(8, 8, 8, dtype=torch.bool)
    reached[2, 5, 7] = reached[0, 0, 3] = True
    expected = torch.zeros(cells + 1, cells + 1, cells + 1, dtype=torch.bool)
    for cell in reached.nonzero():
        places = (cell + torch.rand(3000, 3)) / 8
        low = (places * cells).long().clamp(max=cells - 1)
        for corner in torch.cartesian_prod(*[torch.arange(2)] * 3):
            expected[tuple((low + corner).T)] = True
    assert torch.equal(vertices_in(reached, cells), expected)


def some_cells() -> torch.Tensor:
    return torch.rand(8, 8, 8, generator=torch.Generator().manual_seed(1)) < 0.02


def inside(reached: torch.Tensor) -> torch.Tensor:
    cells = reached.nonzero().repeat(20, 1)
    return BOX.to_world((cells + torch.rand(len(cells), 3)) / 8)


@FIELDS
def test_prune_reached_places_keep_their_values(make: Make):
    field, reached = make(), some_cells()
    positions = inside(reached)
    directions = normalize(torch.randn(len(positions), 3), dim=1)
    before = [part.detach() for part in field(positions, directions)[:2]]
    field.prune(reached)
    for found, was in zip(field(positions, directions)[:2], before, strict=True):
        torch.testing.assert_close(found, was)


def test_prune_few_cells_leaves_less():
    reached = some_cells()
    grid, sparse = hashgrid(entries=12), voxels(finest=12, coarsest=12)
    assert isinstance(grid, HashGridField) and isinstance(sparse, VoxelField)
    rows = len(sparse.log_density)
    grid.prune(reached)
    sparse.prune(reached)
    assert 0.2 < float((grid.grid.tables == 0).all(1).float().mean()) < 0.95
    assert len(sparse.log_density) < rows / 2 and len(sparse.seen) == len(sparse.log_density)


@FIELDS
def test_export_state_of_pruned_field_imports_alike(make: Make):
    field, other = make(), make()
    field.prune(some_cells())
    other.import_state(field.export_state())
    positions, directions = BOX.to_world(torch.rand(40, 3)), normalize(torch.randn(40, 3), dim=1)
    for found, was in zip(other(positions, directions)[:2], field(positions, directions)[:2], strict=True):
        assert torch.equal(found, was)
