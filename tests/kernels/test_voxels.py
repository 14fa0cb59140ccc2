import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import (
    interpolate_scalar,
    interpolate_voxels,
    locate_vertices,
    spherical_harmonics,
    total_variation,
)

SIDE = 6


def sparse_index(side: int = SIDE) -> Tensor:
    """Rows of a grid's vertices, a third of which are pruned."""
    kept = torch.rand(side**3) > 1 / 3
    return torch.where(kept, kept.cumsum(0), 0).int()


def rows_of(index: Tensor) -> int:
    return int(index.max()) + 1


def vertices_of(index: Tensor) -> Tensor:
    return torch.cat([torch.tensor([-1]), index.nonzero()[:, 0]]).int()


def positions(count: int) -> Tensor:
    """Positions inside the unit cube, on its faces and outside."""
    return torch.cat([torch.rand(count, 3), torch.tensor([[0.0, 0, 0], [1, 1, 1], [-0.5, 0.3, 2]])])


def tables(index: Tensor, terms: int) -> list[Tensor]:
    rows = rows_of(index)
    return [torch.randn(rows), torch.randn(rows, 3), torch.randn(rows, 3 * terms)]


def basis_of(count: int, terms: int) -> Tensor:
    directions = torch.nn.functional.normalize(torch.randn(count, 3), dim=1)
    return spherical_harmonics(directions)[:, 1 : 1 + terms]


def brute_force(values: Tensor, index: Tensor, position: list[float]) -> Tensor:
    """All vertices, each with the weight of a tent around it."""
    total = torch.zeros(values.shape[1:], dtype=torch.float64)
    tents = [[max(0.0, 1 - abs(min(max(p, 0.0), 1.0) * (SIDE - 1) - i)) for i in range(SIDE)] for p in position]
    for at, row in enumerate(index.tolist()):
        i, j, k = at // SIDE**2, at // SIDE % SIDE, at % SIDE
        total += tents[0][i] * tents[1][j] * tents[2][k] * values[row].double()
    return total


def test_interpolate_voxels_any_position_matches_loop_over_vertices(kernels: str):
    index, unit = sparse_index(), positions(20)
    density, color, views = tables(index, 3)
    basis = basis_of(len(unit), 3)
    raw, rgb = interpolate_voxels(density, color, views, *locate_vertices(index, unit), basis)
    for n, position in enumerate(unit.tolist()):
        expected = brute_force(density, index, position)
        torch.testing.assert_close(raw[n].double(), expected, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(interpolate_scalar(density, index, unit)[n].double(), expected, atol=1e-5, rtol=1e-5)
        turned = brute_force(views.view(-1, 3, 3), index, position) @ basis[n].double()
        expected = brute_force(color, index, position) + turned
        torch.testing.assert_close(rgb[n].double(), expected, atol=1e-5, rtol=1e-5)


def test_total_variation_matches_loop_over_neighbors(kernels: str):
    index = sparse_index()
    (values, *_) = tables(index, 0)
    vertex, rows = vertices_of(index), rows_of(index)
    grid, squares = index.view(SIDE, SIDE, SIDE), 0.0
    for at in range(SIDE**3):
        corner = [at // SIDE**2, at // SIDE % SIDE, at % SIDE]
        for axis in range(3):
            for sign in (-1, 1):
                other = list(corner)
                other[axis] += sign
                if 0 <= other[axis] < SIDE and grid[tuple(corner)] > 0 and grid[tuple(other)] > 0:
                    squares += float(values[grid[tuple(corner)]] - values[grid[tuple(other)]]) ** 2
    assert float(total_variation(values, vertex, index, 1, rows)) == pytest.approx(squares / (rows - 1), rel=1e-5)
