import pytest
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.kernels import hash_interpolate
from nerf_lightning.model import HashGrid
from nerf_lightning.model.hashgrid import level_resolutions


@pytest.mark.parametrize(
    ("levels", "coarsest", "finest", "expected"),
    [(1, 16, 256, [16]), (2, 3, 50, [3, 50]), (5, 16, 256, [16, 32, 64, 128, 256]), (3, 7, 7, [7, 7, 7])],
)
def test_level_resolutions_grow_from_coarsest_to_finest(levels, coarsest, finest, expected):
    assert level_resolutions(levels, coarsest, finest) == expected


def test_hash_grid_small_levels_have_one_entry_a_vertex():
    grid = HashGrid(levels=3, log2_entries=9, features=4, coarsest=4, finest=16)
    assert grid.resolutions == [4, 8, 16] and grid.sizes == [125, 512, 512]
    assert grid.tables.shape == (125 + 512 + 512, 4) and grid.width == 12
    assert 0 < grid.tables.abs().max() <= 1e-4
    unit = torch.rand(7, 3)
    assert torch.equal(grid(unit), hash_interpolate(grid.tables, unit, grid.cells, grid.sizes))


@pytest.mark.parametrize(("coarsest", "finest"), [(0, 16), (17, 16)])
def test_hash_grid_that_shrinks_is_refused(coarsest, finest):
    with pytest.raises(InputError, match="model.coarsest"):
        HashGrid(coarsest=coarsest, finest=finest)
