import jaxtyping
import pytest
import torch
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.model import HashGrid, hash_interpolate
from nerf_lightning.model.hashgrid import level_resolutions

LEVELS = [
    pytest.param([3], [64], id="dense, full"),
    pytest.param([4], [128], id="dense, with room"),
    pytest.param([9], [32], id="hashed"),
    pytest.param([1500], [2**14], id="hashed, products beyond 32 bits"),
    pytest.param([2, 5, 11], [27, 216, 64], id="dense and hashed"),
]


def entry(x: int, y: int, z: int, resolution: int, size: int) -> int:
    """Instant-NGP, eq. 4, in whole numbers without bounds; row by row where all corners fit."""
    side = resolution + 1
    if side**3 <= size:
        return x + side * y + side * side * z
    return ((x * 1) ^ (y * 2654435761) ^ (z * 805459861)) % 2**32 % size


def by_hand(tables: Tensor, unit: Tensor, resolutions: list[int], sizes: list[int]) -> Tensor:
    rows = []
    for point in unit.double().clamp(0, 1).tolist():
        features, start = [], 0
        for resolution, size in zip(resolutions, sizes, strict=True):
            low = [min(int(p * resolution), resolution - 1) for p in point]
            share = [p * resolution - c for p, c in zip(point, low, strict=True)]
            total = torch.zeros(tables.shape[1], dtype=torch.float64)
            for i in (0, 1):
                for j in (0, 1):
                    for k in (0, 1):
                        weight = 1.0
                        for bit, f in zip((i, j, k), share, strict=True):
                            weight *= f if bit else 1 - f
                        total += weight * tables[start + entry(low[0] + i, low[1] + j, low[2] + k, resolution, size)]
            features += total.tolist()
            start += size
        rows.append(features)
    return torch.tensor(rows, dtype=torch.float64)


@pytest.mark.parametrize(("resolutions", "sizes"), LEVELS)
def test_interpolation_agrees_with_a_loop_over_corners(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64)
    corner_cases = torch.tensor([[0.0, 0, 0], [1, 1, 1], [0, 1, 0.5], [1, 0.25, 0]])
    unit = torch.cat([torch.rand(40, 3), corner_cases]).double()
    actual = hash_interpolate(tables, unit, resolutions, sizes)
    torch.testing.assert_close(actual, by_hand(tables, unit, resolutions, sizes), atol=1e-9, rtol=1e-9)
    single = hash_interpolate(tables.float(), unit.float(), resolutions, sizes)
    torch.testing.assert_close(single.double(), actual, atol=2e-3, rtol=1e-3)


@pytest.mark.parametrize(("resolutions", "sizes"), LEVELS)
def test_features_are_continuous_across_cells(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64)
    for resolution in resolutions:
        border = torch.rand(60, 3).double()
        border[:20, 0] = border[20:40, 1] = border[40:, 2] = torch.randint(1, resolution, (20,)).double() / resolution
        nudge = 1e-9 * torch.eye(3).double().repeat_interleave(20, 0)
        before, after = (hash_interpolate(tables, border + s * nudge, resolutions, sizes) for s in (-1, 1))
        torch.testing.assert_close(before, after, atol=1e-4, rtol=0)


def test_positions_outside_are_clamped():
    resolutions, sizes = [3, 9], [64, 32]
    tables, unit = torch.randn(96, 2), torch.randn(50, 3) * 3
    inside = hash_interpolate(tables, unit.clamp(0, 1), resolutions, sizes)
    assert torch.equal(hash_interpolate(tables, unit, resolutions, sizes), inside)


def test_a_dense_level_reproduces_a_linear_function():
    resolution = 5
    side = torch.arange(resolution + 1) / resolution
    z, y, x = torch.meshgrid(side, side, side, indexing="ij")
    slope = torch.tensor([2.0, -3.0, 0.7])
    tables = (slope[0] * x + slope[1] * y + slope[2] * z + 0.1).reshape(-1, 1)
    unit = torch.rand(200, 3)
    actual = hash_interpolate(tables, unit, [resolution], [len(tables)])
    torch.testing.assert_close(actual[:, 0], unit @ slope + 0.1, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(("resolutions", "sizes"), [([2], [27]), ([4], [8]), ([1, 3], [8, 16])])
def test_gradients_of_tables_and_positions(resolutions, sizes):
    tables = torch.randn(sum(sizes), 2, dtype=torch.float64, requires_grad=True)
    # Away from the borders, where the slope jumps.
    unit = ((torch.randint(0, 12, (5, 3)) + 0.2 + 0.6 * torch.rand(5, 3)) / 12).double().requires_grad_()
    assert torch.autograd.gradcheck(lambda t, u: hash_interpolate(t, u, resolutions, sizes), (tables, unit))


@pytest.mark.parametrize(
    ("levels", "coarsest", "finest", "expected"),
    [(1, 16, 256, [16]), (2, 3, 50, [3, 50]), (5, 16, 256, [16, 32, 64, 128, 256]), (3, 7, 7, [7, 7, 7])],
)
def test_levels_grow_from_coarsest_to_finest(levels, coarsest, finest, expected):
    assert level_resolutions(levels, coarsest, finest) == expected


def test_a_grid_has_no_more_entries_than_it_needs():
    grid = HashGrid(levels=3, log2_entries=9, features=4, coarsest=4, finest=16)
    assert grid.resolutions == [4, 8, 16] and grid.sizes == [125, 512, 512]
    assert grid.tables.shape == (125 + 512 + 512, 4) and grid.width == 12
    assert 0 < grid.tables.abs().max() <= 1e-4
    unit = torch.rand(7, 3)
    assert torch.equal(grid(unit), hash_interpolate(grid.tables, unit, grid.resolutions, grid.sizes))


@pytest.mark.parametrize(("coarsest", "finest"), [(0, 16), (17, 16)])
def test_a_grid_that_shrinks_is_refused(coarsest, finest):
    with pytest.raises(InputError, match="model.coarsest"):
        HashGrid(coarsest=coarsest, finest=finest)


def test_a_wrong_shape_is_refused_in_tests():
    with pytest.raises(jaxtyping.TypeCheckError):
        hash_interpolate(torch.zeros(27, 2), torch.rand(4, 2), [2], [27])
